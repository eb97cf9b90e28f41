"""Set-points that leave the controller are within the arm's limits after any goals and events."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.control.set_point_gaps import LATE
from common.hardware.interface import HardwareFault
from common.hardware.mock import MockHardware
from common.planning.path import blended_path
from common.planning.retiming import limited_jerk, parametrise
from tests.common.control.test_holding import FEW, LIMITS, winding
from tests.common.control.test_limiter import assert_within
from tests.common.control.trajectories import trajectory
from tests.drivers.rig import START, STEP, Rig

HARD = replace(LIMITS, deceleration=2 * LIMITS.acceleration)


class Sampled(Rig):
    """A rig that checks its set-points cycle by cycle, in pieces that begin at rest."""

    def __init__(self, *args, **tolerances):
        super().__init__(*args, **tolerances)
        self.pieces = [[START] * 4]

    def step(self, seconds=STEP):
        status = super().step(seconds)
        if seconds > LATE * STEP:
            self.pieces.append([self.positions[-2]] * 4)
        self.pieces[-1].append(self.positions[-1])
        return status

    def follow(self, swings=0, speed=1.0):
        """Follow a trajectory until the shoulder is so fast [rad/s]."""
        assert self.accept("a", winding(swings, 0.9)).state == "active"
        while self.velocities[-1][0] < speed:
            self.step()

    def assert_within(self, limits, share=1.0):
        for piece in self.pieces:
            assert_within(piece, limits, share, limits.braking)

    def assert_accepts_and_reaches_a_goal_here(self):
        assert self.accept("here", goal_at(self.q)).state == "active" and self.until_over().state == "succeeded"


class Pushed(MockHardware):
    """An arm that is at once at its set-point, unless it is pushed."""

    def __init__(self, start=START):
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


def goal_at(place):
    """Two points at one place, a microsecond apart."""
    return trajectory([(0.0, place), (1e-6, place)])


@pytest.mark.parametrize("share", [1.0, 0.05])
def test_goals_of_a_microsecond_off_by_their_tolerance_keep_limits_and_speed_scaling(share):
    rig, count = Sampled(LIMITS), 8
    rig.controller.reports.speed_scaling = share
    place, begin = START, rig.now
    for number in range(count):
        place = place + 0.0099
        assert rig.accept(f"{number}", goal_at(place)).state == "active"
        assert rig.until_over(60.0).state == "succeeded"
    assert np.allclose(rig.positions[-1], place)
    rig.assert_within(LIMITS, share)
    assert rig.now - begin > count * 0.05 / share



def test_sharp_points_within_the_slack_are_followed_slower_to_their_end():
    rig = Sampled(LIMITS)
    move = 0.24 * 10.0 * 0.2**2  # in 0.2 s: the cubic between needs half more than the acceleration there is
    assert rig.accept("a", trajectory((t, [q, 0]) for t, q in ((0, 0), (0.2, move), (0.4, 0)))).state == "active"
    assert rig.until_over().state == "succeeded"
    rig.assert_within(LIMITS)
    assert np.max(rig.positions) == pytest.approx(move, abs=1e-3)


@pytest.mark.parametrize("seconds", [0.011, 0.05, 0.09, 0.2, 1.0, 3600.0])
def test_after_a_stall_the_motion_resumes_by_a_short_step_or_from_rest(seconds):
    rig = Sampled(LIMITS)
    rig.follow()
    rig.step(seconds)
    way = np.abs(rig.positions[-1] - rig.positions[-2])
    assert np.all(way <= LATE * STEP * LIMITS.velocity)
    if seconds > LATE * STEP:
        assert np.all(way <= STEP**2 * LIMITS.acceleration)
        rig.assert_within(LIMITS)
    assert rig.until_over().state == "succeeded"
    assert np.allclose(rig.q, [1, 0], atol=2e-3)


def test_arm_pushed_off_its_path_is_held_there_within_limits():
    rig = Sampled(LIMITS, Pushed())
    rig.follow()
    rig.hardware.push(np.array([-0.15, 0.0]), stays=True)
    status = rig.until_over()
    assert (status.state, status.error) == ("aborted", "path_tolerance")
    rig.run(100)
    assert np.allclose(rig.positions[-1], rig.q) and not rig.velocities[-1].any()
    rig.assert_within(HARD)
    rig.assert_accepts_and_reaches_a_goal_here()



EVENTS = st.one_of(
    st.tuples(st.just("hold"), st.booleans()),
    st.tuples(st.just("speed"), st.sampled_from([1.0, 0.5, 0.05])),
    st.tuples(st.just("stall"), st.sampled_from([0.15, 1.0])),
    st.tuples(st.sampled_from(["stop", "abort"]), st.none()),
    st.tuples(st.just("goal"), st.tuples(st.integers(0, 6), st.sampled_from([0.3, 0.95]), st.floats(-0.009, 0.009))),
    st.tuples(st.just("nudge"), st.floats(-0.0099, 0.0099)),
)


@FEW
@given(events=st.lists(st.tuples(st.integers(1, 60), EVENTS), min_size=2, max_size=12))
def test_set_points_stay_within_limits_for_any_events(events):
    rig = Sampled(HARD)
    controller = rig.controller
    for number, (cycles, (event, value)) in enumerate(events):
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
            rig.accept(f"{number}", goal_at(rig.q + value))
        else:
            swings, share, off = value
            message, begin = winding(swings, share), rig.q + off
            for point in message.points:
                point.positions = (begin + point.positions).tolist()
            rig.accept(f"{number}", message)
        rig.run(cycles)
    rig.assert_within(HARD)


@pytest.mark.parametrize("by", [0.02, 0.2])
@pytest.mark.parametrize("moving", [0.0, 0.5])
def test_arm_moved_from_outside_is_held_where_it_is_and_reports_it(by, moving):
    rig = Sampled(LIMITS, Pushed())
    rig.accept("a", winding(0, 0.9))
    assert rig.until_over().state == "succeeded"
    rig.step()
    rig.hardware.push(np.full(2, by))
    rig.hardware._velocities = np.full(2, moving)
    there = rig.q
    rig.pieces.append([there - moving * STEP * k for k in (3, 2, 1, 0)])
    rig.step()
    assert np.allclose(rig.positions[-1] - there, moving * STEP, atol=STEP**2 * LIMITS.acceleration.max())
    assert "was moved from outside" in rig.controller.pop_log_line() and not rig.controller.pop_log_line()
    assert "moved from outside" in rig.controller.status.message
    rig.run(100)
    assert not rig.velocities[-1].any()
    rig.assert_within(LIMITS)
    rig.assert_accepts_and_reaches_a_goal_here()


def test_arm_that_does_not_stay_where_it_is_held_is_a_fault():
    rig = Rig(LIMITS, Pushed())
    rig.step()
    rig.hardware.push(np.full(2, 0.05))
    rig.step()
    rig.hardware.push(np.full(2, 0.05))
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


def test_arm_found_in_motion_after_a_restart_is_braked_from_where_it_is():
    speed = np.array([1.5, -0.4])
    rig = Sampled(HARD, Coasting(START, speed))
    rig.step()
    assert len(rig.positions) == 1 and rig.accept("a", winding(0, 0.9)).error == "busy"
    rig.pieces = [[speed * STEP * k for k in (-2, -1, 0, 1)]]
    rig.run(100)
    assert not rig.velocities[-1].any() and np.all(np.abs(rig.q) < 0.3) and not rig.controller.pop_log_line()
    rig.assert_within(HARD)


def test_arm_that_reports_its_commanded_velocity_is_held_where_it_is():
    rig = Sampled(LIMITS)
    rig.follow()
    for again in (Rig(LIMITS, rig.hardware), rig):
        rig.controller.fault("cable is off")
        where = rig.q
        again.now += 1.0
        again.run(5)
        assert np.array_equal(again.positions[-4:], [where] * 4)


@pytest.mark.parametrize("deviation", [0.11, -0.3])
def test_arm_with_a_constant_deviation_gets_no_jump_and_no_goal(deviation):
    class Deviating(MockHardware):
        by = 0.0

        def read(self, now):
            q, dq = super().read(now)
            return q + self.by, dq

    rig = Sampled(LIMITS, Deviating(START, None))
    rig.follow()
    rig.hardware.by = np.array([deviation, 0.0])
    assert rig.until_over().error == "path_tolerance"
    rig.run(300)
    assert np.array_equal(rig.positions[-1], rig.positions[-100])
    rig.assert_within(HARD)
    assert rig.accept("b", goal_at(rig.q)).error == "not_followed"
    rig.hardware.by = 0.0
    rig.run(3)
    assert rig.accept("c", goal_at(rig.q)).state == "active"


@pytest.mark.parametrize("seconds", [0.03, 0.4, 3.0])
@pytest.mark.parametrize("coasted", [0.0, 0.005, 0.06])
def test_after_a_stall_the_motion_ramps_up_from_where_the_arm_is(seconds, coasted):
    rig = Sampled(LIMITS, Pushed())
    rig.follow(3, 0.2)
    rig.hardware.push(np.array([coasted, 0.0]))
    there = rig.q if coasted > 0.01 else rig.positions[-1]
    rig.step(seconds)
    rig.pieces[-1] = [there] * 4 + [rig.positions[-1]]
    assert np.all(np.abs(rig.positions[-1] - there) <= STEP**2 * LIMITS.acceleration)
    assert rig.until_over().state == "succeeded" and np.allclose(rig.q, [1, 0.3 * np.sin(3 * np.pi)], atol=2e-3)
    rig.assert_within(LIMITS)


def test_arm_moved_far_during_a_stall_is_held_there_and_the_goal_aborted():
    rig = Sampled(LIMITS, Pushed())
    rig.follow()
    rig.hardware.push(np.array([0.3, 0.0]))
    there = rig.q
    status = rig.step(3.0)
    assert (status.state, status.error) == ("aborted", "path_tolerance") and "no set-points" in status.message
    assert np.array_equal(rig.positions[-1], there)


@pytest.mark.parametrize("cycles", [1.0, 2.0, 5.0])
def test_acceleration_steps_are_followed_slowly_enough_to_keep_the_jerk_limit(cycles):
    """From the full acceleration to the full braking within no time, of arms that take some cycles for it."""
    limits = replace(LIMITS, jerk=LIMITS.acceleration / (cycles * STEP))
    rig = Sampled(limits)
    a, half = 0.98 * LIMITS.acceleration, 0.15
    message = trajectory([(0.0, 0 * a), (half, a * half**2 / 2, a * half), (2 * half, a * half**2)])
    begin = rig.now
    assert rig.accept("a", message).state == "active" and rig.until_over().state == "succeeded"
    rig.assert_within(limits)
    jerk = np.diff([START] * 3 + rig.positions, 3, axis=0) / STEP**3
    assert np.all(np.abs(jerk) <= 1.021 * limits.jerks)
    assert rig.now - begin <= 2 * half * np.cbrt(2 * cycles) * 1.3 + 0.1


@pytest.mark.parametrize("seed", [0, 4])
def test_trajectory_at_the_limits_continues_on_its_path_after_a_stall(seed):
    bends = np.concatenate([np.zeros((1, 2)), np.random.default_rng(seed).uniform(-1, 1, (4, 2))])
    timed = parametrise(blended_path(bends, np.full(5, 0.3))[0], 0.985 * LIMITS.velocity, 0.985 * LIMITS.acceleration)
    timed = limited_jerk(timed, 100 * LIMITS.acceleration)
    message = trajectory(zip(timed.times, timed.positions, timed.velocities, timed.accelerations, strict=True))
    for share in np.linspace(0.05, 0.9, 6):
        rig = Sampled(LIMITS)
        rig.accept("a", message)
        rig.run(int(share * timed.duration / STEP))
        rig.step(0.4)
        while rig.step().state == "active":
            assert rig.controller._goal.behind == 0.0, "every set-point is on the path"
        assert rig.controller.status.state == "succeeded"
        rig.assert_within(LIMITS)
