"""Whatever was accepted and happens then, the set-points that leave the controller are ones that an arm can follow."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.control.controller import LARGEST_STEP, LATE
from common.hardware.mock import MockHardware
from common.messages import JointTrajectory, JointTrajectoryPoint
from tests.common.control.test_holding import LIMITS, winding
from tests.common.control.test_limiter import assert_within
from tests.common.hardware.rig import START, STEP, Rig

HARD = replace(LIMITS, deceleration=2 * LIMITS.acceleration)


class Sampled(Rig):
    """A rig whose set-points are looked at cycle by cycle, in pieces that begin at rest."""

    def __init__(self, *args, **tolerances):
        super().__init__(*args, **tolerances)
        self.pieces = [[START] * 4]

    def step(self, seconds=STEP):
        status = super().step(seconds)
        if seconds > LARGEST_STEP:
            self.pieces.append([self.positions[-2]] * 4)
        self.pieces[-1].append(self.positions[-1])
        return status

    def assert_within(self, limits, share=1.0):
        for piece in self.pieces:
            assert_within(piece, limits, share, limits.braking)


def goal_at(place, seconds, names=LIMITS.names):
    """Two points at one place."""
    still = [0.0] * len(names)
    points = [JointTrajectoryPoint(time_from_start=t, positions=list(place), velocities=still, accelerations=still)
              for t in (0.0, seconds)]
    return JointTrajectory(joint_names=list(names), points=points)


@pytest.mark.parametrize("share", [1.0, 0.05])
def test_goals_of_a_microsecond_that_are_off_by_their_tolerance_move_within_limits_and_at_the_speed_asked(share):
    rig = Sampled(LIMITS)
    rig.controller.speed_scaling = share
    place, begin = START, rig.now
    for number in range(20):
        place = place + 0.0099
        assert rig.accept(f"{number}", goal_at(place, 1e-6)).state == "active"
        assert rig.until_over(60.0).state == "succeeded"
    assert np.allclose(rig.positions[-1], place)
    rig.assert_within(LIMITS, share)
    assert rig.now - begin > 20 * 0.05 / share


def test_stop_and_go_between_points_too_close_for_their_times_is_followed_slowly_or_refused():
    rig = Sampled(LIMITS)
    points = [JointTrajectoryPoint(time_from_start=k * 1e-6, positions=[k * 1e-6, 0], velocities=[0, 0],
                                   accelerations=[0, 0]) for k in range(20_000)]
    status = rig.accept("a", JointTrajectory(joint_names=list(LIMITS.names), points=points))
    if status.state == "active":
        rig.until_over()
    else:
        assert status.error == "contradiction" and "less than 1%" in status.message
    rig.assert_within(LIMITS)


def test_sharp_points_within_the_slack_of_acceptance_are_followed_slower_and_arrive():
    rig = Sampled(LIMITS)
    move = 0.24 * 10.0 * 0.2**2  # in 0.2 s: the cubic between needs half more than the acceleration there is
    points = [JointTrajectoryPoint(time_from_start=t, positions=[q, 0], velocities=[0, 0], accelerations=[0, 0])
              for t, q in ((0, 0), (0.2, move), (0.4, 0))]
    assert rig.accept("a", JointTrajectory(joint_names=list(LIMITS.names), points=points)).state == "active"
    assert rig.until_over().state == "succeeded"
    rig.assert_within(LIMITS)
    assert np.max(rig.positions) == pytest.approx(move, abs=1e-3)


@pytest.mark.parametrize("seconds", [0.011, 0.05, 0.09, 0.2, 1.0, 3600.0])
def test_stall_is_followed_by_a_short_step_or_by_a_start_from_rest(seconds):
    rig = Sampled(LIMITS)
    rig.accept("a", winding(0, 0.9))
    while rig.velocities[-1][0] < 1.0:
        rig.step()
    rig.step(seconds)
    way = np.abs(rig.positions[-1] - rig.positions[-2])
    assert np.all(way <= LATE * STEP * LIMITS.velocity)
    if seconds > LARGEST_STEP:
        assert np.all(way <= STEP**2 * LIMITS.acceleration)
        rig.assert_within(LIMITS)
    assert rig.until_over().state == "succeeded"
    assert np.allclose(rig.q, [1, 0], atol=2e-3)


def test_arm_that_is_off_is_taken_back_within_limits():
    rig = Sampled(LIMITS)
    rig.accept("a", winding(0, 0.9))
    while rig.velocities[-1][0] < 1.0:
        rig.step()
    rig.controller.abort("path_tolerance", "pushed", rig.q - 0.15)
    where = rig.q - 0.15
    for _ in range(100):
        rig.step()
    assert np.allclose(rig.positions[-1], where) and not rig.velocities[-1].any()
    rig.assert_within(HARD)
    assert rig.accept("b", goal_at(where, 1e-6)).state == "active" and rig.until_over().state == "succeeded"


def test_set_points_begin_where_the_arm_is_found():
    rig = Sampled(LIMITS, MockHardware(np.array([0.7, -0.4]), None))
    for _ in range(5):
        rig.step()
    assert np.array_equal(rig.positions[1:], [[0.7, -0.4]] * 5)


EVENTS = st.one_of(
    st.tuples(st.just("hold"), st.booleans()),
    st.tuples(st.just("speed"), st.sampled_from([1.0, 0.5, 0.05])),
    st.tuples(st.just("stall"), st.sampled_from([0.15, 1.0])),
    st.tuples(st.just("stop"), st.none()),
    st.tuples(st.just("abort"), st.floats(-0.1, 0.1)),
    st.tuples(st.just("goal"), st.tuples(st.integers(0, 6), st.sampled_from([0.3, 0.95]), st.floats(-0.009, 0.009))),
    st.tuples(st.just("nudge"), st.floats(-0.0099, 0.0099)),
)


@settings(max_examples=40, deadline=None)
@given(events=st.lists(st.tuples(st.integers(1, 60), EVENTS), min_size=2, max_size=12))
def test_whatever_happens_set_points_stay_within_limits(events):
    rig = Sampled(HARD)
    for number, (cycles, (event, value)) in enumerate(events):
        controller = rig.controller
        if event == "hold":
            controller.hold(value, "tested")
        elif event == "speed":
            controller.speed_scaling = value
        elif event == "stall":
            rig.step(value)
        elif event == "stop":
            controller.cancel("", "tested", rig.now)
        elif event == "abort":
            controller.abort("path_tolerance", "pushed", rig.q + value)
        elif event == "nudge":
            rig.accept(f"{number}", goal_at(rig.q + value, 1e-6))
        else:
            swings, share, off = value
            trajectory = winding(swings, share)
            begin = rig.q + off
            for point in trajectory.points:
                point.positions = (begin + point.positions).tolist()
            rig.accept(f"{number}", trajectory)
        for _ in range(cycles):
            rig.step()
    rig.assert_within(HARD)
