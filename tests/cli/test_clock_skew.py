"""What `zencell doctor` says of clocks that do not agree."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from common.clock import Clock
from common.config import Parameters
from common.process.service import serve_parameters
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from tools.doctor.clocks import Skew, clock_findings, skews_of


class Shifted(Clock):
    """The clock of a host that is ahead [s, wall]."""

    def __init__(self, like: Clock, ahead: float) -> None:
        super().__init__(like.speed, like.epoch_ns)
        self._offset_ns += int(ahead * 1e9)


@asynccontextmanager
async def services(clock: Clock, **ahead: float) -> AsyncIterator[Bus]:
    """A tool's bus in a cell of services whose clocks are ahead by so much."""
    net = LocalNetwork()
    buses = [net.bus(name, cell="toy", clock=Shifted(clock, by)) for name, by in ahead.items()]
    for bus in buses:
        serve_parameters(bus, Parameters())
        await bus.ready()
    yield net.bus("tool", cell="toy", clock=clock)
    for bus in buses:
        await bus.close()


@pytest.mark.parametrize("speed", [1.0, 5.0])
async def test_skew_is_measured_in_wall_time_and_within_its_uncertainty(speed: float) -> None:
    clock = Clock(speed)
    async with services(clock, camera_simulator=1.3, vision_detector=0.0, smart_pick_place=-0.5) as bus:
        found = await skews_of(bus, clock, {"camera_simulator", "vision_detector", "smart_pick_place"})
    for service, ahead in (("camera_simulator", 1.3), ("vision_detector", 0.0), ("smart_pick_place", -0.5)):
        # Two clocks of one computer are set from its time in turns: a little more than the round trip.
        assert abs(found[service].ahead - ahead) <= found[service].uncertainty + 1e-3


async def test_service_that_does_not_answer_is_left_out() -> None:
    clock = Clock()
    async with services(clock, vision_detector=0.0) as bus:
        assert set(await skews_of(bus, clock, {"vision_detector", "motion_planner"})) == {"vision_detector"}


def test_clocks_that_agree_take_one_line() -> None:
    (finding,) = clock_findings("panda", {"a": Skew(0.001, 0.0005), "b": Skew(-0.004, 0.0006)})
    assert finding.level == "ok" and "2 services" in finding.what
    assert "4.0 ms behind this one (± 0.6 ms)" in finding.what


@pytest.mark.parametrize(("ahead", "level"), [(0.04, "ok"), (-0.1, "warn"), (1.3, "fail"), (-1.3, "fail")])
def test_clock_that_is_off_is_named_with_what_to_do(ahead: float, level: str) -> None:
    findings = list(clock_findings("panda", {"camera_simulator": Skew(ahead, 0.001)}))
    assert [finding.level for finding in findings] == [level]
    if level != "ok":
        assert "panda/camera_simulator" in findings[0].what and "chrony" in findings[0].remedy
    assert ("motion is refused" in findings[0].what) == (level == "fail")


def test_what_the_round_trip_can_not_tell_is_no_fault_of_a_clock() -> None:
    (finding,) = clock_findings("panda", {"camera_simulator": Skew(1.3, 1.3)})
    assert finding.level == "ok"
