"""Whether the service of a container is ready: `python -m common.process.health`, exit code 0 or 1.

It asks the router for the service's readiness token, which also vanishes when the process is frozen or cut off. One
that is frozen it ends, for the engine to start it again. It imports nothing but Zenoh, because it is started every
few seconds beside every service.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from common.transport.credentials import ROUTER_NAME, common_name, credentials_of, secure_folder
from common.transport.endpoint import endpoint_of
from common.transport.router import is_reached
from common.transport.session import ROUTER, alive_key

TIMEOUT = 1.0  # [s]
FIRST_PROCESS = Path("/proc/1/cmdline")


def first_service() -> str:
    """Name of the service that is the container's first process; empty when it is something else."""
    command = FIRST_PROCESS.read_bytes().decode(errors="replace").replace("\0", " ")
    # Also where something else restarts it, which is told the command.
    found = re.search(r" -m ([\w.]+)(?: --name (\w+))?", command)
    return (found[2] or found[1].rpartition(".")[2]) if found else ""


def is_ready(endpoint: str, cell: str, service: str) -> bool:
    """Whether the router is there and, for another service than the router, its token too."""
    folder = secure_folder()
    name = ROUTER_NAME if service == ROUTER else common_name(cell, service)
    credentials = credentials_of(name, folder) if folder else None
    return is_reached(endpoint, "" if service == ROUTER else alive_key(cell, service), TIMEOUT, credentials)


def main() -> int:
    """Exit code: 0 when it is ready."""
    parser = argparse.ArgumentParser(prog="health", description=__doc__.splitlines()[0])
    parser.add_argument("--cell", default=os.environ.get("ZENCELL_CELL", ""), help="first part of its keys")
    parser.add_argument("--service", help="that of the container's first process if not given")
    options = parser.parse_args()
    service = options.service or first_service()
    if end_if_frozen():
        sys.stderr.write(f"{options.cell}/{service} was frozen and is killed\n")
        return 1
    endpoint = endpoint_of()
    if is_ready(endpoint, options.cell, service):
        return 0
    sys.stderr.write(f"{options.cell}/{service} is not ready at {endpoint}\n")
    return 1


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


if __name__ == "__main__":
    sys.exit(main())
