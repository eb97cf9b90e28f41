"""Whether the clocks of a running cell's services agree: stamps are times of the clock on the wall of each host."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tools.doctor import Finding, fail, ok, warn

if TYPE_CHECKING:
    from common.clock import Clock
    from common.transport.bus import Bus

TRIES = 5  # the quickest counts
TIMEOUT = 1.0  # [s] for each
GOOD, BEARABLE = 0.05, 0.2  # [s] beyond the second motion is refused (clock_tolerance)
REMEDY = ("keep time on every host with one source (chrony: `chronyc tracking`, `chronyc waitsync` before the cell is "
          "started), then start its services anew")


@dataclass(frozen=True)
class Skew:
    """How far a service's clock is ahead of ours [s, wall], and how far that may be off: half the round trip."""

    ahead: float
    uncertainty: float


def clocks(endpoint: str) -> Iterator[Finding]:
    """Whether the clocks agree, for each cell that is up at an endpoint."""
    from common.client.joining import is_listening

    if not is_listening(endpoint):
        return
    for cell, skews in sorted(asyncio.run(_all_skews(endpoint)).items()):
        yield from judged(cell, skews)


def judged(cell: str, skews: Mapping[str, Skew]) -> Iterator[Finding]:
    """What is to be said of the clocks of a cell's services: one line for all that agree, one for each other."""
    good = {}
    for service, skew in sorted(skews.items()):
        off = max(0.0, abs(skew.ahead) - skew.uncertainty)  # what is certain
        if off <= GOOD:
            good[service] = skew
            continue
        said = f"the clock of {cell}/{service} is {_told(skew)}"
        yield fail(f"{said}: motion is refused", REMEDY) if off > BEARABLE else warn(said, REMEDY)
    if good:
        worst = max(good.values(), key=lambda skew: abs(skew.ahead))
        yield ok(f"the clocks of {len(good)} services of {cell} agree with this one: the worst is {_told(worst)}")


def _told(skew: Skew) -> str:
    side = "ahead of" if skew.ahead > 0 else "behind"
    return f"{1e3 * abs(skew.ahead):.1f} ms {side} this one (± {1e3 * skew.uncertainty:.1f} ms)"


async def skews_of(bus: Bus, clock: Clock, services: set[str]) -> dict[str, Skew]:
    """By service how far its clock is ahead; those that do not answer are left out.

    Args:
        bus: in the cell.
        clock: of this host, by the cell's speed and epoch.
        services: names.
    """
    from common import topics
    from common.errors import RequestFailed
    from common.messages import ParameterRequest

    found: dict[str, Skew] = {}
    for service in sorted(services):
        client = bus.client(topics.parameters_of(service))
        for _ in range(TRIES):
            began = clock.now_ns()
            try:
                reply = await client.call(ParameterRequest(), TIMEOUT)
            except RequestFailed:
                break  # `node list` says who does not answer
            ended = clock.now_ns()
            if not reply.header.stamp:
                break  # of a version that does not say
            # Answered somewhere between the two: at the middle, give or take half of it.
            ahead = (reply.header.stamp - (began + ended) / 2) / clock.speed * 1e-9
            skew = Skew(ahead, (ended - began) / 2 / clock.speed * 1e-9)
            if service not in found or skew.uncertainty < found[service].uncertainty:
                found[service] = skew
    return found


async def _all_skews(endpoint: str) -> dict[str, dict[str, Skew]]:
    from common.client.joining import TOOL, cell_clock, ready_services
    from common.errors import NoRouter
    from common.transport.connect import connect

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
        return {}  # what listens there is no router: the line on the port says so
