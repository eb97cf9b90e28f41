"""Ends the service of a container that is frozen as a whole (SIGSTOP), so that the engine starts it again.

An engine that finds a container unhealthy does nothing about it: Compose starts again only what has ended. A service
whose loop is stuck ends itself (loop_watch.py); one that is stopped can not. The health check, which runs beside it,
does it in its place. For that the service must not be the container's first process, which nobody in the container
can kill: with `init: true` it is the child of one that ends when it does. Without, as in Kubernetes, which kills what
is not well by itself, nothing is found here and nothing is done.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

PROC = Path("/proc")
FIRST = 1  # the container's init
LOOKS, PERIOD = 12, 0.25  # stopped at so many looks [s]: looks and not time, which also passes while nobody runs


def stopped_service(parent: int = FIRST) -> int | None:
    """The process id of a service that was started by `parent` and is stopped; None if there is none.

    One that a debugger holds does not count, nor does one that something else keeps going, such as watchfiles.
    """
    for folder in PROC.glob("[0-9]*"):
        try:
            state, its_parent = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[:2]
            if int(its_parent) == parent and state == "T" and b"\0-m\0" in (folder / "cmdline").read_bytes():
                return int(folder.name)
        except OSError:  # it has ended meanwhile
            continue
    return None


def end_if_frozen(parent: int = FIRST, wait: Callable[[float], None] = time.sleep) -> bool:
    """Kill the service if it is stopped and stays so for three seconds; whether it was killed."""
    found = stopped_service(parent)
    if found is None:
        return False
    for _ in range(LOOKS):
        wait(PERIOD)
        if stopped_service(parent) != found:
            return False
    os.kill(found, signal.SIGKILL)
    return True
