"""Whatever was accepted and happens then, the set-points that leave the controller are ones that an arm can follow."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.control.trajectory_controller import LATE
from common.hardware.interface import HardwareFault
from common.hardware.mock import MockHardware
from common.messages import JointTrajectory, JointTrajectoryPoint
from common.planning.path import blended_path
from common.planning.retiming import limited_jerk, parametrise
from tests.common.control.test_holding import LIMITS, winding
from tests.common.control.test_limiter import assert_within
from tests.drivers.rig import START, STEP, Rig

HARD = replace(LIMITS, deceleration=2 * LIMITS.acceleration)


class Sampled(Rig):
    """A rig whose set-points are looked at cycle by cycle, in pieces that begin at rest."""

    def __init__(self, *args, **tolerances):
        super().__init__(*args, **tolerances)
        self.pieces = [[START] * 4]

    def step(self, seconds=STEP):
        status = super().step(seconds)
        if seconds > LATE * STEP:
            self.pieces.append([self.positions[-2]] * 4)
        self.pieces[-1].append(self.positions[-1])
        return status

    def assert_within(self, limits, share=1.0):
        for piece in self.pieces:
            assert_within(piece, limits, share, limits.braking)


class Pushed(MockHardware):
    """An arm that is at once at its set-point, unless it is pushed."""

    def __init__(self, start):
        super().__init__(start, None)
        self.fixed = None

    def push(self, by, stays=False):
        """Displace it, for good if it `stays`."""
        self._positions = self._positions + by
        self._velocities = 0 * by
        self.fixed = self._positions.copy() if stays else None

    def read(self, now):
        q, dq = super().read(now)
        return (q, dq) if self.fixed is None else (self.fixed.copy(), 0 * dq)


def goal_at(place, seconds, names=LIMITS.names):
    """Two points at one place."""
    still = [0.0] * len(names)
    points = [JointTrajectoryPoint(time_from_start=t, positions=list(place), velocities=still, accelerations=still)
              for t in (0.0, seconds)]
    return JointTrajectory(joint_names=list(names), points=points)


@pytest.mark.parametrize("share", [1.0, 0.05])
def test_goals_of_a_microsecond_off_by_their_tolerance_keep_limits_and_speed_scaling(share):
    rig = Sampled(LIMITS)
    rig.controller.reports.speed_scaling = share
    place, begin = START, rig.now
    for number in range(20):
        place = place + 0.0099
        assert rig.accept(f"{number}", goal_at(place, 1e-6)).state == "active"
        assert rig.until_over(60.0).state == "succeeded"
    assert np.allclose(rig.positions[-1], place)
    rig.assert_within(LIMITS, share)
    assert rig.now - begin > 20 * 0.05 / share


def test_points_too_close_in_time_are_followed_slowly_or_refused():
    rig = Sampled(LIMITS)
    points = [JointTrajectoryPoint(time_from_start=k * 1e-6, positions=[k * 1e-6, 0], velocities=[0, 0],
                                   accelerations=[0, 0]) for k in range(20_000)]
    status = rig.accept("a", JointTrajectory(joint_names=list(LIMITS.names), points=points))
    if status.state == "active":
        rig.until_over()
    else:
        assert status.error == "contradiction" and "less than 1%" in status.message
    rig.assert_within(LIMITS)


def test_sharp_points_within_the_slack_are_followed_slower_to_their_end():
    rig = Sampled(LIMITS)
    move = 0.24 * 10.0 * 0.2**2  # in 0.2 s: the cubic between needs half more than the acceleration there is
    points = [JointTrajectoryPoint(time_from_start=t, positions=[q, 0], velocities=[0, 0], accelerations=[0, 0])
              for t, q in ((0, 0), (0.2, move), (0.4, 0))]
    assert rig.accept("a", JointTrajectory(joint_names=list(LIMITS.names), points=points)).state == "active"
    assert rig.until_over().state == "succeeded"
    rig.assert_within(LIMITS)
    assert np.max(rig.positions) == pytest.approx(move, abs=1e-3)


@pytest.mark.parametrize("seconds", [0.011, 0.05, 0.09, 0.2, 1.0, 3600.0])
def test_after_a_stall_the_motion_resumes_by_a_short_step_or_from_rest(seconds):
    rig = Sampled(LIMITS)
    rig.accept("a", winding(0, 0.9))
    while rig.velocities[-1][0] < 1.0:
        rig.step()
    rig.step(seconds)
    way = np.abs(rig.positions[-1] - rig.positions[-2])
    assert np.all(way <= LATE * STEP * LIMITS.velocity)
    if seconds > LATE * STEP:
        assert np.all(way <= STEP**2 * LIMITS.acceleration)
        rig.assert_within(LIMITS)
    assert rig.until_over().state == "succeeded"
    assert np.allclose(rig.q, [1, 0], atol=2e-3)


def test_arm_pushed_off_its_path_is_held_there_within_limits():
    hardware = Pushed(START)
    rig = Sampled(LIMITS, hardware)
    rig.accept("a", winding(0, 0.9))
    while rig.velocities[-1][0] < 1.0:
        rig.step()
    hardware.push(np.array([-0.15, 0.0]), stays=True)
    status = rig.until_over()
    assert (status.state, status.error) == ("aborted", "path_tolerance")
    for _ in range(100):
        rig.step()
    where = hardware.read(rig.now)[0]
    assert np.allclose(rig.positions[-1], where) and not rig.velocities[-1].any()
    rig.assert_within(HARD)
    assert rig.accept("b", goal_at(where, 1e-6)).state == "active" and rig.until_over().state == "succeeded"


def test_set_points_start_where_the_arm_is():
    rig = Sampled(LIMITS, MockHardware(np.array([0.7, -0.4]), None))
    for _ in range(5):
        rig.step()
    assert np.array_equal(rig.positions[1:], [[0.7, -0.4]] * 5)


EVENTS = st.one_of(
    st.tuples(st.just("hold"), st.booleans()),
    st.tuples(st.just("speed"), st.sampled_from([1.0, 0.5, 0.05])),
    st.tuples(st.just("stall"), st.sampled_from([0.15, 1.0])),
    st.tuples(st.just("stop"), st.none()),
    st.tuples(st.just("abort"), st.none()),
    st.tuples(st.just("goal"), st.tuples(st.integers(0, 6), st.sampled_from([0.3, 0.95]), st.floats(-0.009, 0.009))),
    st.tuples(st.just("nudge"), st.floats(-0.0099, 0.0099)),
)


@settings(max_examples=40, deadline=None)
@given(events=st.lists(st.tuples(st.integers(1, 60), EVENTS), min_size=2, max_size=12))
def test_set_points_stay_within_limits_for_any_events(events):
    rig = Sampled(HARD)
    for number, (cycles, (event, value)) in enumerate(events):
        controller = rig.controller
        if event == "hold":
            controller.hold(value, "tested")
        elif event == "speed":
            controller.reports.speed_scaling = value
        elif event == "stall":
            rig.step(value)
        elif event == "stop":
            controller.cancel("", "tested", rig.now)
        elif event == "abort":
            controller.abort("path_tolerance", "pushed")
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


@pytest.mark.parametrize("by", [0.02, 0.2])
@pytest.mark.parametrize("moving", [0.0, 0.5])
def test_arm_moved_from_outside_is_held_where_it_is_and_reports_it(by, moving):
    hardware = Pushed(START)
    rig = Sampled(LIMITS, hardware)
    rig.accept("a", winding(0, 0.9))
    assert rig.until_over().state == "succeeded"
    rig.step()
    hardware.push(np.full(2, by))
    hardware._velocities = np.full(2, moving)
    there = rig.q
    rig.pieces.append([there - moving * STEP * k for k in (3, 2, 1, 0)])
    rig.step()
    assert np.allclose(rig.positions[-1] - there, moving * STEP, atol=STEP**2 * LIMITS.acceleration.max())
    assert "was moved from outside" in rig.controller.pop_log_line() and not rig.controller.pop_log_line()
    assert "moved from outside" in rig.controller.status.message
    for _ in range(100):
        rig.step()
    assert not rig.velocities[-1].any()
    rig.assert_within(LIMITS)
    assert rig.accept("b", goal_at(rig.q, 1e-6)).state == "active" and rig.until_over().state == "succeeded"


def test_arm_that_does_not_stay_where_it_is_held_is_a_fault():
    hardware = Pushed(START)
    rig = Rig(LIMITS, hardware)
    rig.step()
    hardware.push(np.full(2, 0.05))
    rig.step()
    hardware.push(np.full(2, 0.05))
    with pytest.raises(HardwareFault, match=r"shoulder was moved from outside by 0\.0500 rad again"):
        rig.step()


class Coasting(Pushed):
    """An arm that continues at its speed without set-points."""

    def __init__(self, start, speed):
        super().__init__(start)
        self._velocities, self.then = speed, None

    def read(self, now):
        if self.then is not None:
            self._positions = self._positions + self._velocities * (now - self.then)
        self.then = now
        return super().read(now)

    def write(self, positions, velocities, now):
        self.then = None
        super().write(positions, velocities, now)


def test_arm_found_in_motion_is_braked_from_where_it_is():
    """As after a restart of the executor in the middle of a motion."""
    speed = np.array([1.5, -0.4])
    rig = Sampled(HARD, Coasting(START, speed))
    rig.step()
    assert len(rig.positions) == 1 and rig.accept("a", winding(0, 0.9)).error == "busy"
    rig.pieces = [[speed * STEP * k for k in (-2, -1, 0, 1)]]
    for _ in range(100):
        rig.step()
    assert not rig.velocities[-1].any() and np.all(np.abs(rig.q) < 0.3) and not rig.controller.pop_log_line()
    rig.assert_within(HARD)


def test_arm_that_only_reports_a_velocity_is_held_where_it_is():
    """An arm that reports its commanded velocity."""
    rig = Sampled(LIMITS)
    rig.accept("a", winding(0, 0.9))
    while rig.velocities[-1][0] < 1.0:
        rig.step()
    for again in (Rig(LIMITS, rig.hardware), rig):
        rig.controller.fault("cable is off")
        where = rig.q
        again.now += 1.0
        for _ in range(5):
            again.step()
        assert np.array_equal(again.positions[-4:], [where] * 4)


@pytest.mark.parametrize("amiss", [0.11, -0.3])
def test_arm_with_a_constant_deviation_gets_no_jump_and_no_goal(amiss):
    class Amiss(MockHardware):
        by = 0.0

        def read(self, now):
            q, dq = super().read(now)
            return q + self.by, dq

    hardware = Amiss(START, None)
    rig = Sampled(LIMITS, hardware)
    rig.accept("a", winding(0, 0.9))
    while rig.velocities[-1][0] < 1.0:
        rig.step()
    hardware.by = np.array([amiss, 0.0])
    assert rig.until_over().error == "path_tolerance"
    for _ in range(300):
        rig.step()
    assert np.array_equal(rig.positions[-1], rig.positions[-100])
    rig.assert_within(HARD)
    assert rig.accept("b", goal_at(rig.q, 1e-6)).error == "not_followed"
    hardware.by = 0.0
    for _ in range(3):
        rig.step()
    assert rig.accept("c", goal_at(rig.q, 1e-6)).state == "active"


@pytest.mark.parametrize("seconds", [0.03, 0.4, 3.0])
@pytest.mark.parametrize("coasted", [0.0, 0.005, 0.06])
def test_after_a_stall_the_motion_ramps_up_from_where_the_arm_is(seconds, coasted):
    hardware = Pushed(START)
    rig = Sampled(LIMITS, hardware)
    rig.accept("a", winding(3, 0.9))
    while rig.velocities[-1][0] < 0.2:
        rig.step()
    hardware.push(np.array([coasted, 0.0]))
    there = rig.q if coasted > 0.01 else rig.positions[-1]
    rig.step(seconds)
    rig.pieces[-1] = [there] * 4 + [rig.positions[-1]]
    assert np.all(np.abs(rig.positions[-1] - there) <= STEP**2 * LIMITS.acceleration)
    assert rig.until_over().state == "succeeded" and np.allclose(rig.q, [1, 0.3 * np.sin(3 * np.pi)], atol=2e-3)
    rig.assert_within(LIMITS)


def test_arm_moved_far_during_a_stall_is_held_there_and_the_goal_aborted():
    hardware = Pushed(START)
    rig = Sampled(LIMITS, hardware)
    rig.accept("a", winding(0, 0.9))
    while rig.velocities[-1][0] < 1.0:
        rig.step()
    hardware.push(np.array([0.3, 0.0]))
    there = rig.q
    status = rig.step(3.0)
    assert (status.state, status.error) == ("aborted", "path_tolerance") and "no set-points" in status.message
    assert np.array_equal(rig.positions[-1], there)


@pytest.mark.parametrize("cycles", [1.0, 2.0, 5.0])
def test_acceleration_steps_are_followed_slowly_enough_to_keep_the_jerk_limit(cycles):
    """From the fullest acceleration to the fullest braking within no time, of arms that take some cycles for it."""
    limits = replace(LIMITS, jerk=LIMITS.acceleration / (cycles * STEP))
    rig = Sampled(limits)
    a, half = 0.98 * LIMITS.acceleration, 0.15
    points = [JointTrajectoryPoint(time_from_start=t, positions=q.tolist(), velocities=v.tolist(), accelerations=[0, 0])
              for t, q, v in ((0.0, 0 * a, 0 * a), (half, a * half**2 / 2, a * half), (2 * half, a * half**2, 0 * a))]
    given_ = JointTrajectory(joint_names=list(LIMITS.names), points=points)
    begin = rig.now
    assert rig.accept("a", given_).state == "active" and rig.until_over().state == "succeeded"
    rig.assert_within(limits)
    jerk = np.diff([START] * 3 + rig.positions, 3, axis=0) / STEP**3
    assert np.all(np.abs(jerk) <= 1.021 * limits.jerks)
    assert rig.now - begin <= 2 * half * np.cbrt(2 * cycles) * 1.3 + 0.1


@pytest.mark.parametrize("seed", [0, 4])
def test_trajectory_at_the_limits_continues_on_its_path_after_a_stall(seed):
    bends = np.concatenate([np.zeros((1, 2)), np.random.default_rng(seed).uniform(-1, 1, (4, 2))])
    path = blended_path(bends, np.full(5, 0.3))[0]
    timed = parametrise(path, 0.985 * LIMITS.velocity, 0.985 * LIMITS.acceleration)
    timed = limited_jerk(timed, 100 * LIMITS.acceleration)
    states = zip(timed.times.tolist(), timed.positions.tolist(), timed.velocities.tolist(),
                 timed.accelerations.tolist(), strict=True)
    points = [JointTrajectoryPoint(time_from_start=t, positions=q, velocities=dq, accelerations=ddq)
              for t, q, dq, ddq in states]
    for share in np.linspace(0.05, 0.9, 12):
        rig = Sampled(LIMITS)
        rig.accept("a", JointTrajectory(joint_names=list(LIMITS.names), points=points))
        for _ in range(int(share * timed.duration / STEP)):
            rig.step()
        rig.step(0.4)
        while rig.step().state == "active":
            assert rig.controller._goal.behind == 0.0, "every set-point is on the path"
        assert rig.controller.status.state == "succeeded"
        rig.assert_within(LIMITS)
