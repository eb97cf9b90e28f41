"""Checks ports, message versions of running cells, and certificates."""

from __future__ import annotations

import asyncio
import datetime
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

from tools.doctor import Finding, fail, ok, warn

ROUTER_MODULE = "services.router"
VIEWER_MODULE = "services.viewer"
PAGE_HOST, PAGE_PORT = "127.0.0.1", 8080
TIMEOUT = 1.0  # [s]


def router(endpoint: str) -> Finding:
    """Check the port of the domain's router."""
    from common.transport.router import port_holder

    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=TIMEOUT):
            pass
    except ConnectionRefusedError:
        return ok(f"{endpoint} is free: no cell is up there")
    except OSError as error:
        return warn(f"{endpoint} cannot be reached ({error})", "check --connect and the network")
    holder = port_holder(int(port))
    if ROUTER_MODULE in holder:
        return ok(f"{endpoint}: a router of zencell answers there, {holder}")
    return warn(f"{endpoint} is in use by {holder}", "stop it, or give zencell another --domain")


def page() -> Finding:
    """Check the port of the operator's page."""
    from common.transport.router import port_holder

    where = f"port {PAGE_PORT} of the operator's page"
    with socket.socket() as probe:
        probe.settimeout(TIMEOUT)
        if probe.connect_ex((PAGE_HOST, PAGE_PORT)):
            return ok(f"{where} is free")
    holder = port_holder(PAGE_PORT)
    if VIEWER_MODULE in holder:
        return ok(f"{where}: a page of zencell is served there, {holder}")
    return warn(f"{where} is in use by {holder}", "zencell takes the next free one; --viewer-port N chooses another")


def versions(endpoint: str) -> Iterator[Finding]:
    """Check that running cells use the same message version and the same Python."""
    from common.client.joining import is_listening

    if not is_listening(endpoint):
        return
    for cell, problem in sorted(asyncio.run(schema_problems(endpoint)).items()):
        if problem:
            yield fail(f"cell {cell} at {endpoint}: {problem}", "run the cell and this tool from the same version")
        else:
            yield ok(f"cell {cell} at {endpoint} has the message version of this tool")
    foreign = foreign_interpreters(service_commands())
    if foreign:
        listed = ", ".join(f"{pid} ({python})" for pid, python in foreign.items())
        yield warn(f"services run by another Python than this one: {listed}",
                   "their packages may differ: start the cell from this environment, or use that one's zencell")


async def schema_problems(endpoint: str) -> dict[str, str]:
    """Return the problem with the message version by running cell; empty if there is none."""
    from common import topics
    from common.client.joining import TOOL, ready_services
    from common.errors import DecodeError, NoRouter
    from common.messages import SupervisorStatus
    from common.transport.codec import decode, decode_attachment
    from common.transport.zenoh_session import connect

    found: dict[str, str] = {}
    try:
        async with connect(cell="_", service=TOOL, endpoint=endpoint, timeout=TIMEOUT) as bus:
            for cell in {name for name, _ in await ready_services(bus)}:
                found[cell] = ""
                for sample in await bus.raw_get(f"{cell}/{topics.SUPERVISOR_STATUS.key}", TIMEOUT):
                    try:
                        decode_attachment(sample.attachment)
                        decode(SupervisorStatus, sample.payload)
                    except DecodeError as error:
                        found[cell] = str(error)
    except NoRouter:
        return {}  # no router listens there: `router` reports it
    return found


def service_commands() -> dict[int, list[str]]:
    """Return the command lines of all services on this host by process id."""
    import psutil

    found = {}
    for process in psutil.process_iter(["cmdline"]):
        command = process.info["cmdline"] or []
        if "--gate" in command and "-m" in command:
            found[process.pid] = command
    return found


def foreign_interpreters(commands: dict[int, list[str]]) -> dict[int, str]:
    """Return the Python executable by process id, for processes that another Python runs."""
    here = Path(sys.executable).parent
    return {pid: command[0] for pid, command in commands.items() if Path(command[0]).parent != here}


def certificates(now: datetime.datetime | None = None) -> Iterator[Finding]:
    """Check how long the certificates of `ZENCELL_SECURE` are valid; without access control there are none."""
    from common.transport.credentials import expiries_in, expiry_warning, secure_folder

    folder = secure_folder()
    if folder is None:
        return
    at = now or datetime.datetime.now(datetime.UTC)
    ends = expiries_in(folder)
    if not ends:
        yield fail(f"{folder} has no readable certificates", "create them with `zencell secure init`")
    found = {name: expiry_warning(name, until, at) for name, until in ends.items()}
    for problem in found.values():
        if problem is not None:
            urgent, line = problem
            yield (fail if urgent else warn)(line, f"zencell secure renew {folder}")
    if ends and not any(found.values()):
        yield ok(f"{len(ends)} certificates in {folder}, the first expires on {min(ends.values()):%Y-%m-%d}")
