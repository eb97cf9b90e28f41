"""A trajectory joins the goal that is followed, at speed: what is refused, and the set-points across the join."""

from __future__ import annotations

import numpy as np
import pytest
import ruckig

from common.control.joining import Join
from common.control.limiter import SLACK
from common.control.trajectory_controller import PERIOD, TrajectoryController
from common.hardware.interface import Limits
from common.messages import ExecuteRequest, FollowedRequest, HoldRequest, JointTrajectory, MotionStatus
from tests.common.control.rig import ExecutorRig
from tests.common.control.trajectories import LIMITS as TWO_JOINTS
from tests.common.control.trajectories import rest_to_rest, trajectory

DOF = 6
LIMITS = Limits(
    tuple(f"j{n}" for n in range(DOF)), np.full(DOF, -6.0), np.full(DOF, 6.0), np.full(DOF, 3.0), np.full(DOF, 5.0),
    np.full(DOF, 10.0), np.full(DOF, 500.0))
State = tuple[np.ndarray, np.ndarray, np.ndarray]


class Arm:
    """An arm that is where it is commanded, and the motions that it was given."""

    def __init__(self, start: np.ndarray) -> None:
        self.controller, self.now = TrajectoryController(LIMITS, start), 100.0
        self.q, self.dq, self.sent = start, 0.0 * start, [start]
        self.controller.update(self.now, self.q, self.dq)
        self.way = ruckig.Trajectory(DOF)
        self.count = 0

    @property
    def status(self) -> MotionStatus:
        return self.controller.status

    def motion(self, state: State, target: np.ndarray) -> JointTrajectory:
        """The fastest motion within the limits from a state to rest."""
        given = ruckig.InputParameter(DOF)
        given.current_position, given.current_velocity, given.current_acceleration = map(list, state)
        given.target_position = target.tolist()
        given.max_velocity, given.max_acceleration = LIMITS.velocity.tolist(), LIMITS.acceleration.tolist()
        given.max_jerk = LIMITS.jerks.tolist()
        self.way = ruckig.Trajectory(DOF)
        ruckig.Ruckig(DOF).calculate(given, self.way)
        times = [*np.arange(0.0, self.way.duration - PERIOD / 2, PERIOD), self.way.duration]
        return trajectory(((time, *self.way.at_time(time)) for time in times), LIMITS.names)

    def start(self, target: np.ndarray) -> MotionStatus:
        return self.controller.accept("0", self.motion((self.q, self.dq, 0 * self.q), target), self.now, self.q)

    def join(self, target: np.ndarray, after: float = 0.05, **joins: object) -> MotionStatus:
        """Continue the newest motion to another target, `after` so long on its path [s]."""
        self.count += 1
        time = self.status.path_time + after
        if after > PERIOD:  # at a point of the newest motion, not before it
            time = max(PERIOD * np.ceil(time / PERIOD - 1e-6), 0.0)
        q, dq, ddq = map(np.array, self.way.at_time(time))
        given = {"goal": self.status.id, "time": time, **joins}
        message = self.motion((q + given.pop("off", 0.0), dq + given.pop("faster", 0.0), ddq), target)
        return self.controller.accept(
            str(self.count), message, self.now, self.q, join=Join(**given))  # type: ignore[arg-type]

    def run(self, cycles: int = 1) -> None:
        for _ in range(cycles):
            self.now += PERIOD
            set_point = self.controller.update(self.now, self.q, self.dq)
            assert set_point is not None
            self.q, self.dq = set_point
            self.sent.append(self.q)

    def until_over(self) -> MotionStatus:
        for _ in range(3000):
            self.run()
            if self.status.state != "active":
                return self.status
        raise AssertionError("not over")

    def most(self) -> tuple[float, float, float]:
        """Largest velocity, acceleration and jerk by differences of set-points, as shares of the limits."""
        sent = np.array([self.sent[0]] * 3 + self.sent)
        v, a, j = (np.abs(np.diff(sent, n=n, axis=0)).max() / PERIOD**n for n in (1, 2, 3))
        return v / LIMITS.velocity[0], a / LIMITS.acceleration[0], j / LIMITS.jerks[0]


def moving(seed: int = 0, cycles: int = 30) -> tuple[Arm, np.random.Generator]:
    rng = np.random.default_rng(seed)
    arm = Arm(rng.uniform(-2, 2, DOF))
    assert arm.start(rng.uniform(-2, 2, DOF)).state == "active"
    arm.run(cycles)
    return arm, rng


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("speed", [1.0, 0.4])
def test_set_points_keep_all_limits_across_many_joins(seed: int, speed: float) -> None:
    arm, rng = moving(seed)
    arm.controller.reports.speed_scaling = speed
    for _ in range(25):
        answer = arm.join(rng.uniform(-2, 2, DOF), float(rng.uniform(0.011, 0.2)))
        assert answer.state == "active", answer.message
        arm.run(int(rng.integers(8, 50)))  # some join a motion that has not joined the one before yet
    end = np.array(arm.way.at_time(arm.way.duration)[0])
    assert (arm.until_over().state, arm.status.progress) == ("succeeded", 1.0)
    assert np.allclose(arm.q, end, atol=1e-6)
    v, a, j = arm.most()
    assert v <= 1 + SLACK and a <= 1 + SLACK and j <= 1 + (SLACK if speed == 1.0 else 0.2), (v, a, j)


def test_hold_before_a_join_leaves_it_valid_and_the_path_passes_through_it() -> None:
    arm, _ = moving()
    old, at = arm.way, arm.status.path_time + 0.4
    joined = arm.join(0.0 * arm.q, 0.4)
    assert (joined.state, joined.path_time) == ("active", pytest.approx(-0.4))
    arm.controller.hold(True, "wait")
    arm.run(200)
    assert arm.status.path_time < 0 and arm.controller.at_rest
    q = np.array(old.at_time(at + arm.status.path_time)[0])
    assert np.allclose(arm.q, q, atol=1e-6)
    arm.controller.hold(False, "go on")
    assert arm.until_over().state == "succeeded" and np.allclose(arm.q, 0.0, atol=1e-6)
    v, a, _ = arm.most()
    assert v <= 1 + SLACK and a * LIMITS.acceleration[0] <= LIMITS.braking[0] * (1 + SLACK)


@pytest.mark.parametrize("after", [0.011, 0.1])
@pytest.mark.parametrize("wait", [0, 1, 2, 12])
def test_stop_after_a_join_brakes_along_the_joined_path(after: float, wait: int) -> None:
    arm, _ = moving()
    arm.join(0.0 * arm.q, after)
    arm.run(wait)
    arm.controller.cancel("", "enough", arm.now)
    way = arm.way
    assert arm.join(1.0 + 0.0 * arm.q).error == "stopping"
    status = arm.until_over()
    assert (status.id, status.state, status.error) == ("1", "cancelled", "cancelled")
    assert status.path_time < way.duration - 0.1
    if status.path_time >= 0:
        assert np.allclose(arm.q, way.at_time(status.path_time)[0], atol=1e-6)
    v, a, j = arm.most()
    assert v <= 1 + SLACK and a * LIMITS.acceleration[0] <= LIMITS.braking[0] * (1 + SLACK) and j <= 1 + SLACK


@pytest.mark.parametrize(("joins", "code", "words"), [
    ({"goal": "other"}, "unknown_goal", "'other' is not followed"),
    ({"after": 0.005}, "too_late", "at 0.300 s"),
    ({"after": -0.2}, "too_late", "nothing can join it at 0.100 s"),
    ({"after": 9.0}, "too_late", "which ends at"),
    ({"off": 1e-4}, "discontinuous", "starts with j"),
    ({"faster": 0.01}, "discontinuous", "the speed of j"),
])
def test_what_cannot_join_is_refused_and_the_motion_continues(joins: dict[str, object], code: str, words: str) -> None:
    arm, _ = moving()
    end = np.array(arm.way.at_time(arm.way.duration)[0])
    refused = arm.join(0.0 * arm.q, **joins)  # type: ignore[arg-type]
    assert (refused.state, refused.error) == ("rejected", code) and words in refused.message
    assert arm.status.id == "0" and arm.until_over().state == "succeeded" and np.allclose(arm.q, end, atol=1e-6)


def test_nothing_joins_an_arm_at_rest_and_a_jump_of_acceleration_beyond_the_jerk_is_refused() -> None:
    arm, _ = moving()
    q, dq, _ = map(np.array, arm.way.at_time(0.4))
    harder = arm.motion((q, dq, np.full(DOF, -4.9)), 0.0 * q)
    refused = arm.controller.accept("x", harder, arm.now, arm.q, join=Join("0", 0.4))
    assert (refused.state, refused.error) == ("rejected", "limit")
    arm.until_over()
    assert arm.join(0.0 * arm.q).error == "unknown_goal"


def test_requests_show_the_new_goal_and_the_complete_path() -> None:
    rig = ExecutorRig(TWO_JOINTS)
    rig.step()
    first = rest_to_rest([0, 0], [1, 0], 2.0)
    rig.execute("a", first)
    rig.run(0.5)
    rig.executor.authority.hold(HoldRequest(hold=True, by="scene_monitor", goal="a"))
    rig.run(0.05)
    rest = trajectory([(point.time_from_start - first.points[8].time_from_start, point.positions, point.velocities,
                        point.accelerations) for point in first.points[8:]])
    request = ExecuteRequest(id="b", trajectory=rest, joins="a", join_time=0.8)
    answer = rig.executor.execute(request, rig.now)
    assert answer.state == "active", answer.message
    assert rig.executor.execute(request, rig.now).id == "b"  # a repeated request changes nothing
    replaced = rig.execute("a", first)
    assert (replaced.state, replaced.error) == ("cancelled", "replaced")
    rig.run(0.3)
    assert rig.motions[-1].held_by == ["scene_monitor"]  # until the monitor has checked the new path
    followed = rig.executor.followed(FollowedRequest(id="b").id)
    assert followed.trajectory.points[-1].time_from_start == pytest.approx(2.0)
    assert followed.trajectory.points[0].positions == [0, 0]
    rig.executor.authority.hold(HoldRequest(hold=False, by="scene_monitor"))
    rig.run(2.5)
    assert (rig.motions[-1].id, rig.motions[-1].state) == ("b", "succeeded")
    assert rig.motions[-1].path_time == pytest.approx(1.2, abs=0.02)
