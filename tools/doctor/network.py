"""Checks of the network and of the clocks of a cell's hosts."""

from __future__ import annotations

import asyncio
import datetime
import socket
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tools.doctor import Finding, fail, ok, warn

if TYPE_CHECKING:
    from common.clock import Clock
    from common.transport.bus import Bus

ROUTER_MODULE = "services.router"
VIEWER_MODULE = "services.viewer"
PAGE_HOST, PAGE_PORT = "127.0.0.1", 8080
TIMEOUT = 1.0  # [s] per request


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


TRIES = 5  # requests per service; the fastest reply counts
GOOD, BEARABLE = 0.05, 0.2  # [s] beyond the second, motion is refused (clock_tolerance)
REMEDY = ("keep time on every host with one source (chrony: `chronyc tracking`, `chronyc waitsync` before the cell is "
          "started), then restart its services")


@dataclass(frozen=True)
class Skew:
    """Difference of a service's clock to the local one [s, wall time], and its uncertainty: half the round trip."""

    ahead: float
    uncertainty: float


def clocks(endpoint: str) -> Iterator[Finding]:
    """Check the clocks of each running cell at an endpoint."""
    from common.client.joining import is_listening

    if not is_listening(endpoint):
        return
    for cell, skews in sorted(asyncio.run(_all_skews(endpoint)).items()):
        yield from clock_findings(cell, skews)


def clock_findings(cell: str, skews: Mapping[str, Skew]) -> Iterator[Finding]:
    """Yield one finding for all clocks that agree, and one for each other clock."""
    good = {}
    for service, skew in sorted(skews.items()):
        off = max(0.0, abs(skew.ahead) - skew.uncertainty)  # certain difference
        if off <= GOOD:
            good[service] = skew
            continue
        what = f"the clock of {cell}/{service} is {_format(skew)}"
        yield fail(f"{what}: motion is refused", REMEDY) if off > BEARABLE else warn(what, REMEDY)
    if good:
        worst = max(good.values(), key=lambda skew: abs(skew.ahead))
        yield ok(f"the clocks of {len(good)} services of {cell} agree with this one: the worst is {_format(worst)}")


def _format(skew: Skew) -> str:
    side = "ahead of" if skew.ahead > 0 else "behind"
    return f"{1e3 * abs(skew.ahead):.1f} ms {side} this one (± {1e3 * skew.uncertainty:.1f} ms)"


async def skews_of(bus: Bus, clock: Clock, services: set[str]) -> dict[str, Skew]:
    """Return the clock difference by service; services that do not answer are left out.

    Args:
        bus: in the cell.
        clock: of this host, with the cell's speed and epoch.
        services: their names.
    """
    from common import topics
    from common.errors import RequestFailed
    from common.messages import ParameterRequest

    found: dict[str, Skew] = {}
    for service in sorted(services):
        client = bus.client(topics.parameters_of(service))
        for _ in range(TRIES):
            started = clock.now_ns()
            try:
                reply = await client.call(ParameterRequest(), TIMEOUT)
            except RequestFailed:
                break  # `node list` shows services that do not answer
            ended = clock.now_ns()
            if not reply.header.stamp:
                break  # an old version without stamps
            # The reply was stamped between the two times: assume the middle.
            ahead = (reply.header.stamp - (started + ended) / 2) / clock.speed * 1e-9
            skew = Skew(ahead, (ended - started) / 2 / clock.speed * 1e-9)
            if service not in found or skew.uncertainty < found[service].uncertainty:
                found[service] = skew
    return found


async def _all_skews(endpoint: str) -> dict[str, dict[str, Skew]]:
    from common.client.joining import TOOL, cell_clock, ready_services
    from common.errors import NoRouter
    from common.transport.zenoh_session import connect

    services: dict[str, set[str]] = {}
    try:
        async with connect(cell="_", service=TOOL, endpoint=endpoint, timeout=TIMEOUT) as bus:
            for cell, service in await ready_services(bus):
                services.setdefault(cell, set()).add(service)
        found = {}
        for cell, names in services.items():
            async with connect(cell=cell, service=TOOL, endpoint=endpoint, timeout=TIMEOUT) as bus:
                found[cell] = await skews_of(bus, await cell_clock(bus), names - {"supervisor"})
        return found
    except NoRouter:
        return {}  # no router listens there: `network.router` reports it
