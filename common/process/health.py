"""Health check of a container: `python -m common.process.health` exits with 0 if its service is ready, else 1.

It looks up the readiness token of the service at the router. The token vanishes also if the process is frozen or
disconnected. A stopped process is killed, so that the container engine restarts it. This module imports only Zenoh,
because it is started every few seconds for every service.
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
PROC = Path("/proc")
FIRST_PROCESS = PROC / "1/cmdline"
FIRST = 1  # process id of the container's init
CHECKS, PERIOD = 12, 0.25  # stopped in that many checks [s]; counted, because time also passes while nothing runs


def first_service() -> str:
    """Return the name of the service that is the container's first process; empty for another program."""
    command = FIRST_PROCESS.read_bytes().decode(errors="replace").replace("\0", " ")
    # The first process may also be a program that restarts the service, with its command as arguments.
    found = re.search(r" -m ([\w.]+)(?: --name (\w+))?", command)
    return (found[2] or found[1].rpartition(".")[2]) if found else ""


def is_ready(endpoint: str, cell: str, service: str) -> bool:
    """Return whether the router is reached and holds the readiness token of the service."""
    folder = secure_folder()
    name = ROUTER_NAME if service == ROUTER else common_name(cell, service)
    credentials = credentials_of(name, folder) if folder else None
    return is_reached(endpoint, "" if service == ROUTER else alive_key(cell, service), TIMEOUT, credentials)


def main() -> int:
    """Check the service and return the exit code."""
    parser = argparse.ArgumentParser(prog="health", description=__doc__.splitlines()[0])
    parser.add_argument("--cell", default=os.environ.get("ZENCELL_CELL", ""), help="name of the cell")
    parser.add_argument("--service", help="name of the service; default: the container's first process")
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


def stopped_service(parent: int = FIRST) -> int | None:
    """Return the process id of a stopped service that `parent` started, or None.

    A process that a debugger holds does not count, nor one that another program supervises, such as watchfiles.
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
    """Kill the service if it stays stopped for three seconds; return whether it was killed."""
    found = stopped_service(parent)
    if found is None:
        return False
    for _ in range(CHECKS):
        wait(PERIOD)
        if stopped_service(parent) != found:
            return False
    os.kill(found, signal.SIGKILL)
    return True


if __name__ == "__main__":
    sys.exit(main())
