"""Checks that the clocks of a running cell's services agree: stamps are system times of each host."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tools.doctor import Finding, fail, ok, warn

if TYPE_CHECKING:
    from common.clock import Clock
    from common.transport.bus import Bus

TRIES = 5  # requests per service; the fastest reply counts
TIMEOUT = 1.0  # [s] per request
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
