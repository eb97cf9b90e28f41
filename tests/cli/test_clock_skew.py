"""Findings of `zencell doctor` about the clocks of a cell's hosts."""

import pytest

from common.clock import Clock
from common.config import Parameters
from common.process.service import serve_parameters
from common.transport.local import LocalNetwork
from tools.doctor.network import Skew, clock_findings, skews_of


class Shifted(Clock):
    """The clock of a host that is ahead [s, wall]."""

    def __init__(self, like: Clock, ahead: float) -> None:
        super().__init__(like.speed, like.epoch_ns, like.booted_ns + int(ahead * 1e9))


@pytest.mark.parametrize("speed", [1.0, 5.0])
async def test_skew_is_measured_in_wall_time_within_its_uncertainty(speed):
    net, clock = LocalNetwork(), Clock(speed)
    skews = {"camera_simulator": 1.3, "vision_detector": 0.0, "smart_pick_place": -0.5}
    buses = [net.bus(name, cell="toy", clock=Shifted(clock, ahead)) for name, ahead in skews.items()]
    for bus in buses:
        serve_parameters(bus, Parameters())
        await bus.ready()
    tool = net.bus("tool", cell="toy", clock=clock)
    found = await skews_of(tool, clock, {*skews, "motion_planner"})  # which does not answer
    assert found.keys() == skews.keys()
    for service, ahead in skews.items():
        assert abs(found[service].ahead - ahead) <= found[service].uncertainty + 1e-6  # stamps are rounded
    for bus in buses:
        await bus.close()


def test_clocks_that_agree_are_one_line():
    (finding,) = clock_findings("panda", {"a": Skew(0.001, 0.0005), "b": Skew(-0.004, 0.0006)})
    assert finding.level == "ok" and "2 services" in finding.what
    assert "4.0 ms behind this one (± 0.6 ms)" in finding.what


@pytest.mark.parametrize(("ahead", "uncertainty", "level"), [
    (0.04, 0.001, "ok"), (-0.1, 0.001, "warn"), (1.3, 0.001, "fail"), (-1.3, 0.001, "fail"), (1.3, 1.3, "ok")])
def test_skewed_clock_is_named_with_a_remedy(ahead, uncertainty, level):
    (finding,) = clock_findings("panda", {"camera_simulator": Skew(ahead, uncertainty)})
    assert finding.level == level
    if level != "ok":
        assert "panda/camera_simulator" in finding.what and "chrony" in finding.remedy
    assert ("motion is refused" in finding.what) == (level == "fail")
