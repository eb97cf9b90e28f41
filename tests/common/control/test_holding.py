"""Holds and changes of speed: the arm stays on its path and within its limits."""

import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.hardware.interface import Limits
from common.hardware.lag import LagHardware
from tests.common.control.trajectories import trajectory
from tests.drivers.rig import START, STEP, T0, Rig

LIMITS = Limits(("shoulder", "elbow"), -3 * np.ones(2), 3 * np.ones(2), 2 * np.ones(2), np.array([10.0, 5.0]))
FEW = settings(max_examples=settings.default.max_examples // 3)


def winding(swings, share, points=400):
    """The shoulder goes from 0 to 1 while the elbow swings; at a share of what velocity or acceleration limits allow.

    Time runs through the geometry as 10 u^3 - 15 u^4 + 6 u^5.
    """
    u = np.linspace(0.0, 1.0, points)
    s, ds, dds = 10 * u**3 - 15 * u**4 + 6 * u**5, 30 * u**2 * (1 - u) ** 2, 60 * u - 180 * u**2 + 120 * u**3
    k = np.pi * swings
    q = np.stack([s, 0.3 * np.sin(k * s)], axis=1)
    dq = np.stack([ds, 0.3 * k * np.cos(k * s) * ds], axis=1)
    ddq = np.stack([dds, 0.3 * k * (np.cos(k * s) * dds - k * np.sin(k * s) * ds**2)], axis=1)
    duration = max(np.abs(dq / LIMITS.velocity).max(), np.sqrt(np.abs(ddq / LIMITS.acceleration).max())) / share
    return trajectory(zip(u * duration, q, dq / duration, ddq / duration**2, strict=True))


class Timed(Rig):
    """A rig that remembers how long its steps were."""

    def __init__(self, *args, **tolerances):
        super().__init__(*args, **tolerances)
        self.steps = []

    def step(self, seconds=STEP):
        self.steps.append(seconds)
        return super().step(seconds)

    def until_rest(self):
        """Step until the arm is at rest; return how long that took [s]."""
        before = self.now
        while self.velocities[-1].any():
            self.step()
        return self.now - before

    def follow(self, message, seconds):
        """Follow a trajectory for some time."""
        assert self.accept("a", message).state == "active"
        while self.now - T0 < seconds:
            self.step()

    def assert_on_path_within(self, limits, swings):
        positions, velocities = np.array(self.positions), np.array(self.velocities)
        assert np.allclose(positions[:, 1], 0.3 * np.sin(np.pi * swings * positions[:, 0]), atol=1e-5)
        assert np.all(np.diff(positions[:, 0]) >= -1e-12), "never back"
        assert np.all(np.abs(velocities) <= limits.velocity * 1.001)
        most = np.array(self.steps)[:, None] * limits.braking * 1.01
        assert np.all(np.abs(np.diff(velocities, axis=0)) <= most)


@FEW
@given(
    swings=st.integers(0, 6), share=st.sampled_from([0.5, 0.9, 0.999]), cycle=st.sampled_from([0.004, 0.01, 0.04]),
    events=st.lists(st.tuples(st.floats(0.0, 1.0), st.booleans() | st.floats(0.05, 1.0)), max_size=8),
    seed=st.integers(0, 2**32 - 1),
)
def test_arm_stays_on_its_path_and_within_limits_for_any_holds_and_speeds(swings, share, cycle, events, seed):
    rig, jitter = Timed(LIMITS), random.Random(seed)
    assert rig.accept("a", winding(swings, share)).state == "active"
    for wait, value in events:
        begin = rig.now
        while rig.now - begin < wait:
            rig.step(cycle * jitter.uniform(0.5, 1.5))
        if isinstance(value, bool):
            assert rig.controller.hold(value, "tested").held == value
        else:
            rig.controller.reports.speed_scaling = value
    rig.controller.hold(False, "")
    rig.controller.reports.speed_scaling = 1.0
    status = rig.until_over()
    assert status.state == "succeeded" and np.allclose(rig.q, [1, 0.3 * np.sin(np.pi * swings)], atol=2e-3)
    rig.assert_on_path_within(LIMITS, swings)



@FEW
@given(swings=st.integers(0, 6), share=st.sampled_from([0.5, 0.9]), when=st.floats(0.02, 0.98), stop=st.booleans())
def test_deceleration_limit_is_used_for_holds_and_stops_and_the_arm_stays_on_its_path(swings, share, when, stop):
    took, message = [], winding(swings, share)
    for limits in (LIMITS, replace(LIMITS, deceleration=3 * LIMITS.acceleration)):
        rig = Timed(limits)
        rig.follow(message, when * message.points[-1].time_from_start)
        rig.controller.cancel("a", "tested", rig.now) if stop else rig.controller.hold(True, "")
        took.append(rig.until_rest())
        rig.assert_on_path_within(limits, swings)
    assert took[1] <= took[0] + 1e-6


@FEW
@given(share=st.floats(0.2, 0.5), when=st.floats(0.05, 0.95))
def test_hold_takes_no_longer_than_braking_at_the_limit(share, when):
    rig, message = Timed(LIMITS), winding(0, share)
    rig.follow(message, when * message.points[-1].time_from_start)
    fastest = np.abs(rig.velocities[-1][0])
    rig.controller.hold(True, "")
    # The trajectory takes up a share^2 of the acceleration itself; 30 ms are the least that a hold takes.
    assert rig.until_rest() <= max(0.03, fastest / (LIMITS.acceleration[0] * (1 - share**2))) + 3 * STEP


def test_held_goal_stays_active_without_progress_and_reports_the_reason(limits, rest_to_rest):
    rig = Timed(limits, goal_time=0.1)
    rig.follow(rest_to_rest([0, 0], [1, -0.5]), 0.4)
    answer = rig.controller.hold(True, "people are near")
    assert (answer.id, answer.state, answer.held) == ("a", "active", True)
    assert answer.message == "coming to rest: people are near"
    rig.until_rest()
    there = rig.q
    for _ in range(100):
        status = rig.step(0.1)
    assert (status.state, status.held, status.message) == ("active", True, "held: people are near")
    assert np.array_equal(rig.q, there) and 0.3 < status.progress < 0.6
    answer = rig.controller.hold(False, "gone")
    assert (answer.held, answer.message) == (False, "")
    assert rig.until_over().state == "succeeded"


@pytest.mark.parametrize("hardware", [None, LagHardware(START, 0.03, None)])
def test_held_arm_violates_no_tolerance_with_or_without_lag(limits, rest_to_rest, hardware):
    rig = Rig(limits, hardware, goal_time=0.05, path=0.2)
    rig.accept("a", rest_to_rest([0, 0], [1, -0.5]))
    for number in range(12):
        rig.controller.hold(number % 2 == 0, "")
        for _ in range(40):
            assert rig.step().state == "active" or number > 5
    rig.controller.hold(False, "")
    assert rig.until_over().state == "succeeded"


def test_goal_accepted_while_held_waits_at_its_start_and_is_followed_once(rig, rest_to_rest):
    there = rest_to_rest([0, 0], [1, 1])
    idle = rig.controller.hold(True, "paused")
    assert (idle.state, idle.message) == ("none", "held: paused")
    refused = rig.accept("refused", rest_to_rest([0.5, 0], [1, 1]))
    assert (refused.state, refused.error, refused.held) == ("rejected", "start_mismatch", True)
    assert "starts with shoulder" in refused.message
    answer = rig.accept("a", there)
    assert (answer.state, answer.held, answer.message) == ("active", True, "held: paused")
    rig.run(100)
    assert np.array_equal(rig.q, START)
    assert rig.accept("a", there).state == "active", "a repeated request starts nothing"
    assert rig.accept("b", there).error == "busy"
    assert rig.controller.hold(False, "").message == ""
    assert rig.until_over().state == "succeeded" and np.allclose(rig.q, [1, 1])


@pytest.mark.parametrize("wait", [1, 100])
def test_stop_while_held_cancels_and_the_robot_stays_held(rig, rest_to_rest, wait):
    rig.accept("a", rest_to_rest([0, 0], [1, 1]))
    rig.run(40)
    rig.controller.hold(True, "paused")
    rig.run(wait)
    rig.controller.cancel("a", "given up", rig.now)
    status = rig.until_over()
    assert (status.state, status.held, status.message) == ("cancelled", True, "given up")
    there = rig.q
    assert not rig.controller.hold(False, "").held
    rig.run(10)
    assert np.array_equal(rig.q, there)
    assert rig.accept("b", rest_to_rest(there, [1, 1])).state == "active"
    assert rig.until_over().state == "succeeded"


def test_release_during_a_stop_does_not_end_the_stop(rig, rest_to_rest):
    rig.accept("a", rest_to_rest([0, 0], [1, 1]))
    rig.run(40)
    rig.controller.cancel("a", "given up", rig.now)
    rig.step()
    answer = rig.controller.hold(False, "")
    assert answer.state == "active" and "stopping" in answer.message
    assert rig.until_over().state == "cancelled"



def test_fault_while_held_ends_the_goal_and_the_robot_stays_held(rig, rest_to_rest):
    rig.accept("a", rest_to_rest([0, 0], [1, 1]))
    rig.run(40)
    rig.controller.hold(True, "paused")
    rig.controller.fault("bus is off")
    status = rig.controller.status
    assert (status.state, status.error, status.held) == ("aborted", "hardware_fault", True)
