"""Motions that the arm's speed slider, or a short freeze of driver or executor, holds up continue by themselves."""

import numpy as np
import pytest

from tests.drivers.held_up_arm import HeldUpArm

SLIDERS = [(1.0, 0.0, 0.02, 0.5, 1.0), (0.3, 1.0, 0.05, 0.0, 1.0)]


@pytest.fixture
def arm(monkeypatch):
    return HeldUpArm(monkeypatch, ahead=0.2)


# The last sequence has standstill, a low and the full speed.
DWELLS = [(sequence, 0.1) for sequence in SLIDERS] + [
    pytest.param(sequence, dwell, marks=mark) for sequence in SLIDERS for dwell, mark in (
        (1.0, () if sequence is SLIDERS[-1] else pytest.mark.slow), (30.0, pytest.mark.campaign))]


@pytest.mark.parametrize("jogs", [False, True], ids=["motion", "jog"])
@pytest.mark.parametrize(("sequence", "dwell"), DWELLS, ids=str)
def test_moved_speed_slider_slows_the_arm_without_a_protective_stop(arm, sequence, dwell, jogs):
    if jogs:
        arm.jogs = 0.6
    else:
        arm.move(1.2, 4.0)  # up to 0.56 rad/s
    arm.run(1.2)
    for arm.arm.slider in sequence:
        before = arm.arm.q[0]
        arm.run(dwell)
        assert arm.arm.q[0] - before <= 0.65 * arm.arm.slider * dwell + 0.1, "time of the path follows the arm"
        if arm.arm.slider == 0.0:
            assert np.abs(arm.arm.target - arm.arm.q).max() < (0.03 if dwell < 1.0 else 1e-3)
    arm.jogs = 0.0
    arm.run(6.0)
    assert arm.arm.stops == 0 and not any("does not work" in note or "outside" in note for note in arm.notes)
    assert jogs or (arm.status.state == "succeeded" and np.allclose(arm.arm.q, 1.2, atol=1e-3))


@pytest.mark.parametrize("slider", [1.0, 0.02, 0.0])
@pytest.mark.parametrize("after", [0.05, 0.6], ids="{} s after the slider".format)
def test_stop_is_not_delayed_by_a_low_slider(arm, slider, after):
    arm.move(1.2, 4.0)
    arm.run(1.5)
    arm.arm.slider = slider
    arm.run(after)
    arm.stop()
    arm.run(1.2)
    where = arm.arm.q.copy()
    assert arm.status.state == "cancelled"
    arm.arm.slider = 1.0
    arm.run(1.0)
    assert np.abs(arm.arm.q - where).max() < 0.01 and arm.arm.stops == 0


@pytest.mark.parametrize("jogs", [False, True], ids=["motion", "jog"])
@pytest.mark.parametrize("who", ["driver", "executor"])
@pytest.mark.parametrize(("freeze", "continues"), [(0.06, True), (0.22, False)])
def test_motion_continues_after_a_short_freeze_only(monkeypatch, who, freeze, continues, jogs):
    arm = HeldUpArm(monkeypatch, ahead=0.05)
    if jogs:
        arm.jogs = 0.6
    else:
        arm.move(1.2, 4.0)
    for _ in range(3):
        arm.run(0.5)
        arm.frozen[who] = arm.now + freeze
        arm.run(freeze)
    arm.run(0.5)
    assert arm.arm.stops == 0 and not any("outside" in note for note in arm.notes)
    if continues:
        assert not any("does not work" in note for note in arm.notes)
        assert arm.arm.qd[0] > 0.1, "it moves on"
        arm.run(4.0)
        assert jogs or (arm.status.state == "succeeded" and np.allclose(arm.arm.q, 1.2, atol=1e-3))
        assert arm.executor.robot.resumed == sum("continues" in note for note in arm.notes)
    elif not jogs:
        assert arm.status.state == "aborted", arm.notes


@pytest.mark.parametrize("when", ["at rest", "after a freeze"])
def test_arm_that_is_pushed_is_held_where_it_is(arm, when):
    if when == "after a freeze":
        arm.jogs = 0.6
        arm.run(0.5)
        arm.frozen["executor"] = arm.now + 0.08
        arm.run(0.2)
        arm.jogs = 0.0
        arm.run(1.5)
    arm.arm.q = arm.arm.q + 0.012
    arm.arm.program = False  # it does not move back
    arm.run(0.2)
    assert any("was moved from outside by 0.012" in note for note in arm.notes)
