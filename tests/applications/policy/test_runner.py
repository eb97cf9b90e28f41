"""The task of a policy: the requests that chunks lead to, the end of an episode, and its control."""

from __future__ import annotations

import numpy as np
import pytest

from applications.policy.blending import FollowedPath, blended
from applications.policy.gripping import GripperSchedule
from applications.policy.interface import Chunk, ProvedMotion, Violation
from applications.policy.runner import Join, PolicyTask
from applications.policy.settings import Config, Region
from applications.policy.topics import PolicyStatus
from common.config import load_cell, service_config
from common.control.trajectory import Trajectory
from common.errors import ConfigError
from common.hardware.interface import Limits
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    GripperState,
    Header,
    HoldRequest,
    MotionStatus,
    PlanningScene,
    StopRequest,
)
from common.robot.transforms import matrix_to_pose
from common.tasks.stages import View
from tests.applications.policy.panda import READY, panda

NOW = 1_000.0
ROBOT = panda()
LIMITS = Limits(
    tuple(ROBOT.joint_names), ROBOT.lower, ROBOT.upper, ROBOT.velocity, ROBOT.acceleration, None, ROBOT.jerk)


def config(*settings: str) -> Config:
    cell = load_cell("policy_panda", [f"services.policy_runner.{setting}" for setting in settings])
    return service_config(cell, "policy_runner", Config)


def motion(seconds: float = 1.0, moved: float = 0.1, rows: int = 20, **more: object) -> ProvedMotion:
    """A quintic from READY that moves the first joint, of a chunk with 20 rows."""
    u = np.linspace(0, 1, 21)[:, None]
    way = moved * np.eye(7)[0]
    return ProvedMotion(u.ravel() * seconds, READY + way * (10 * u**3 - 15 * u**4 + 6 * u**5),
                        way * (30 * u**2 - 60 * u**3 + 30 * u**4) / seconds,
                        way * (60 * u - 180 * u**2 + 120 * u**3) / seconds**2, 0.8 * seconds, rows, **more)


class Rig:
    """A task and what it knows, stepped by hand."""

    def __init__(self, *settings: str) -> None:
        self.task = PolicyTask(config(*settings), PolicyStatus(), "p", LIMITS)
        header = Header(stamp=int(NOW * 1e9))
        self.view = View(NOW, PlanningScene(header=header), GripperState(header=header, width=0.08),
                         MotionStatus(header=header), READY.tolist(), matrix_to_pose(ROBOT.fk(READY)))
        self.sent: list[object] = []

    @property
    def status(self) -> PolicyStatus:
        return self.task.status

    def step(self, seconds: float = 0.1, **motion: object) -> list[object]:
        self.view.now += seconds
        if motion:
            header = Header(stamp=round(self.view.now * 1e9))
            self.view.motion = MotionStatus(header=header, **motion)
        sent = self.task.step(self.view)
        self.sent += sent
        return sent

    def chunk(self, rate: float = 20.0, age: float = 0.0) -> Chunk:
        return Chunk(round((self.view.now - age) * 1e9), rate, "joints", np.tile(READY, (20, 1)))

    def send(self, proved: ProvedMotion, widths: object = None, age: float = 0.0) -> Join | None:
        join = self.task.join(self.chunk(age=age), 20, self.view, True, 0.0, None)
        if join is not None:
            self.task.send(proved, join, widths, self.view, 20)
        return join

    def accept(self) -> None:
        """Let the executor accept the request that was sent last."""
        request = next(each for each in reversed(self.sent) if isinstance(each, ExecuteRequest))
        answer = MotionStatus(header=Header(stamp=round(self.view.now * 1e9)), id=request.id, state="active",
                              path_time=-0.04 if request.joins else 0.0)
        self.view.motion = answer
        self.task.on_goal(answer, self.view)


def started(*settings: str) -> Rig:
    rig = Rig(*settings)
    rig.step()
    rig.send(motion())
    rig.step()
    rig.accept()
    return rig


def test_first_chunk_starts_at_rest_and_the_next_joins_it_at_its_state() -> None:
    rig = started()
    assert isinstance(rig.sent[0], ExecuteRequest) and not rig.sent[0].joins
    assert rig.task.wants_chunk(rig.view)
    rig.step(0.3, id="p-1", state="active", path_time=0.3)
    join = rig.send(motion())
    assert join is not None and join.time == pytest.approx(0.34)
    q, dq = rig.task.path.path.at(0.34)
    assert np.allclose(join.state.positions, q) and np.allclose(join.state.velocities, dq)
    assert join.rows[0] == pytest.approx(1 / 20 - 0.04)
    request = rig.step(0.0)[0]
    assert (request.joins, request.join_time) == ("p-1", pytest.approx(0.34))
    assert not rig.task.wants_chunk(rig.view)  # until it is answered
    rig.accept()
    rig.step(0.1, id="p-2", state="active", path_time=0.06)
    assert rig.task.path.id == "p-2" and rig.task.path.time(rig.view.now) == pytest.approx(0.4)
    assert (rig.status.state, rig.status.proved, rig.status.late) == ("ACTING", 2, 0)


def test_committed_rows_are_those_of_the_running_motion_and_stay_while_a_chunk_is_computed() -> None:
    rig = started()
    rig.step(0.3, id="p-1", state="active", path_time=0.3)
    until = rig.task.expected_join(rig.view.now, 0.2)
    assert until == pytest.approx(0.54)
    committed = rig.task.path.committed(rig.view.now - 0.1, 20.0, until)
    assert np.allclose(committed, [rig.task.path.path.at(0.2 + 0.05 * n)[0] for n in range(1, 7)])
    join = rig.task.join(rig.chunk(age=0.1), 20, rig.view, False, 0.0, until)
    assert join is not None and join.time == until  # not earlier, though it is computed sooner


def test_held_or_slowed_arm_keeps_the_times_of_its_path() -> None:
    rig = started()
    rig.step(0.3, id="p-1", state="active", path_time=0.3, speed_scaling=0.5)
    assert rig.task.path.time(rig.view.now + 0.2) == pytest.approx(0.4)
    assert rig.task.join(rig.chunk(), 20, rig.view, False, 0.0, None).time == pytest.approx(0.32)
    rig.step(0.1, id="p-1", state="active", path_time=0.35, held=True)
    assert not rig.task.wants_chunk(rig.view)
    assert rig.task.join(rig.chunk(), 20, rig.view, False, 0.0, None) is None
    assert rig.task.path.time(rig.view.now + 5.0) == pytest.approx(0.35)


@pytest.mark.parametrize(("proved", "counted", "sends"), [
    (motion(), "proved", True),
    (motion(slowed=1.5, violation=Violation("velocity", "panda_joint1", 0.1, "too fast")), "slowed", True),
    (motion(rows=7, violation=Violation("collision", "hand - wall", 0.4, "hand would touch wall")), "shortened", True),
    (motion(rows=0, violation=Violation("jump", "panda_joint2", 0.0, "it jumps")), "refused", False),
    (ProvedMotion(np.zeros(0), np.zeros((0, 7)), np.zeros((0, 7)), np.zeros((0, 7)), 0.0, 0), "refused", False),
])
def test_chunks_are_counted_with_the_reason(proved: ProvedMotion, counted: str, sends: bool) -> None:
    rig = Rig()
    rig.step()
    rig.send(proved)
    sent = rig.step()
    assert getattr(rig.status, counted) == 1 == rig.status.figures[counted]
    assert bool(sent) == sends
    if proved.violation is not None:
        assert (rig.status.violation, rig.status.cause) == (proved.violation.message, proved.violation.cause)
        assert rig.status.figures["violations"] == f"{proved.violation.cause} 1"


def test_chunk_for_a_motion_that_is_nearly_over_is_late_and_a_refused_join_is_no_failure() -> None:
    rig = started()
    rig.step(0.98, id="p-1", state="active", path_time=0.98)
    assert rig.task.join(rig.chunk(), 20, rig.view, False, 0.0, None) is None
    rig.step(0.01, id="p-1", state="active", path_time=0.5)
    rig.send(motion())
    rig.step()
    rig.task.on_goal(MotionStatus(id="p-2", state="rejected", error="too_late"), rig.view)
    assert (rig.status.late, rig.status.failures) == (1, 0) and rig.task.path.id == "p-1"


def test_refusal_hands_over_to_the_operator_if_configured_so() -> None:
    rig = Rig("on_violation=refuse")
    rig.step()
    rig.send(motion(rows=0, violation=Violation("collision", "hand - wall", 0.4, "hand would touch wall after 0.4 s")))
    rig.step()
    assert rig.status.control == "operator" and "hand would touch wall after 0.4 s" in rig.status.message
    assert not rig.task.wants_chunk(rig.view) and not rig.task.wants_motion


def test_operator_takes_over_in_motion_and_gives_back_from_where_the_arm_is() -> None:
    rig = started()
    rig.task.take("anna")
    (stop,) = rig.step(0.1, id="p-1", state="active", path_time=0.3)
    assert isinstance(stop, StopRequest) and (stop.id, stop.by) == ("p-1", "requester")
    assert (rig.status.control, rig.status.operator) == ("operator", "anna")
    seconds = rig.status.task_seconds
    rig.step(0.5, id="p-1", state="cancelled", error="cancelled")
    assert not rig.task.wants_chunk(rig.view) and rig.status.started
    rig.task.give()
    rig.view.q = (READY + 0.1).tolist()
    assert rig.task.wants_chunk(rig.view)
    join = rig.task.join(rig.chunk(), 20, rig.view, True, 0.0, None)
    assert join is not None and join.before is None and np.allclose(join.state.positions, READY + 0.1)
    rig.step(0.1)
    assert rig.status.task_seconds == pytest.approx(seconds + 0.1, abs=0.05)


def test_episode_is_done_at_rest_once_an_object_is_held_at_the_height() -> None:
    rig = started("until={holding: true, height: 0.3}")
    rig.view.gripper = GripperState(width=0.05, holding=True)
    (stop,) = rig.step(0.1, id="p-1", state="active", path_time=0.3)
    assert isinstance(stop, StopRequest) and rig.status.state == "ENDING"
    rig.step(0.1, id="p-1", state="cancelled")
    assert (rig.status.state, rig.status.done, rig.status.message) == ("DONE", 1, "")
    for _ in range(20):  # answers to requests that were under way
        rig.task.fail("too late")
    rig.step()
    assert (rig.status.state, rig.status.message) == ("DONE", "")
    assert isinstance(rig.task.command("start", rig.view)[0], HoldRequest) and rig.status.state == "IDLE"


@pytest.mark.parametrize(("holding", "height"), [(False, 0.3), (True, 1.5)])
def test_episode_continues_until_all_conditions_hold_and_is_an_error_when_its_time_is_over(
    holding: bool, height: float
) -> None:
    rig = Rig(f"until={{holding: true, height: {height}}}", "seconds=2")
    rig.view.gripper = GripperState(width=0.05, holding=holding)
    for _ in range(19):
        rig.step()
    assert rig.status.state == "ACTING"
    for _ in range(3):
        rig.step()
    assert (rig.status.state, rig.status.message) == ("ERROR", "not done within 2 s")


def test_failures_in_a_row_end_the_episode_and_stop_the_arm() -> None:
    rig = started("most_failures=3")
    for _ in range(3):
        rig.task.fail("the server is gone")
    (stop,) = rig.step(0.1, id="p-1", state="active", path_time=0.3)
    assert isinstance(stop, StopRequest) and rig.status.state == "ENDING"
    rig.step(0.1, id="p-1", state="cancelled")
    assert (rig.status.state, rig.status.message) == ("ERROR", "the server is gone (3 failures in a row)")


def test_stop_and_pause_reach_the_arm_and_a_stopped_robot_is_not_moved() -> None:
    rig = started()
    (hold,) = rig.task.command("pause", rig.view)
    assert isinstance(hold, HoldRequest) and hold.hold and not rig.task.wants_chunk(rig.view)
    rig.task.command("resume", rig.view)
    assert rig.task.wants_chunk(rig.view)
    (stop,) = rig.task.command("stop", rig.view)
    assert (stop.id, stop.by) == ("p-1", "operator") and not rig.status.started
    assert rig.step() == [] and not rig.task.wants_chunk(rig.view)


def test_gripper_is_commanded_when_the_row_with_its_width_is_due() -> None:
    rig = Rig()
    rig.step()
    rig.send(motion(), np.array([0.08] * 10 + [0.0] * 10))
    rig.step(0.0)
    rig.accept()
    widths = []
    for _ in range(20):
        widths += [(round(rig.view.now - NOW, 2), each.width) for each in rig.step(
            0.05, id="p-1", state="active", path_time=0.1) if isinstance(each, GripperCommand)]
    assert [width for _, width in widths] == [0.08, 0.0] and widths[1][0] == pytest.approx(0.1 + 0.55, abs=0.06)


def test_widths_around_the_middle_change_nothing() -> None:
    schedule, times = GripperSchedule(0.08), np.arange(6.0)
    schedule.set(times, np.array([0.08, 0.05, 0.039, 0.041, 0.03, 0.042]))
    assert [schedule.due(float(time)) for time in times] == [0.08, None, None, None, 0.03, None]
    schedule.set(times[:2] + 10, np.array([0.2, np.nan]))
    assert schedule.due(10.0) == 0.08 and schedule.due(11.0) is None


def test_rows_leave_the_motion_before_them_gradually_and_completely_before_it_brakes() -> None:
    times = np.linspace(0.0, 1.0, 11)
    path = FollowedPath("a", Trajectory(times, np.zeros((11, 7)), np.zeros((11, 7)), np.zeros((11, 7))), 0.0, 0.5)
    rows, at = np.ones((10, 7)), np.arange(1, 11) / 20
    assert np.allclose(blended(rows, at, path, 0.1, 0.2)[:, 0], np.minimum(at / 0.2, 1.0))
    assert np.allclose(blended(rows, at, path, 0.4, 0.2)[:, 0], np.minimum(at / 0.1, 1.0))  # it brakes after 0.1 s
    assert np.allclose(blended(rows, at, path, 0.6, 0.2), 1.0) and np.allclose(blended(rows, at, path, 0.1, 0.0), 1.0)


@pytest.mark.parametrize(("settings", "words"), [
    (["source={}"], "source"),
    (["source={callable: a:b, onnx: c}"], "exactly one"),
    (["on_violation=clip"], "shorten"),
    (["region={lower: [0, 0, 0], upper: [1, 1, 0]}"], "upper z"),
    (["image_size=[2, 2]"], "image_size"),
])
def test_bad_settings_are_named(settings: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        config(*settings)


def test_region_is_a_box_in_world() -> None:
    box = Region(lower=(0.2, -0.4, 0.0), upper=(0.6, 0.4, 0.5)).box
    assert (box.pose.position.x, box.pose.position.z, box.size.y) == pytest.approx((0.4, 0.25, 0.8))


def restarted(rig: Rig) -> Rig:
    """A task of a new process that continues from the memory of another one."""
    after = Rig()
    after.task.remember(rig.task.memory)
    return after


def test_restart_leaves_an_operator_in_control():
    rig = Rig()
    rig.step()
    before = rig.task.memory
    rig.task.take("ann")
    assert rig.task.memory is not before and rig.task.memory is rig.task.memory
    rig = restarted(rig)
    rig.step()
    assert (rig.status.control, rig.status.operator, rig.task.wants_chunk(rig.view)) == ("operator", "ann", False)
    rig.task.give()
    rig = restarted(rig)
    rig.step()
    assert rig.status.control == "policy" and rig.task.wants_chunk(rig.view)


def test_restart_does_not_begin_an_episode_again():
    rig = Rig("seconds=2.0")
    for _ in range(30):
        rig.step()
    assert rig.status.state == "ERROR"
    rig = restarted(rig)
    rig.step()
    assert (rig.status.state, rig.status.message) == ("ERROR", "not done within 2 s")
    assert not rig.task.wants_chunk(rig.view)
    assert rig.task.command("start", rig.view)
    rig.step()
    assert rig.status.state == "ACTING" and rig.status.task_seconds < 0.2


def test_restart_does_not_prolong_an_episode():
    rig = Rig()
    for _ in range(15):
        rig.step()
    assert restarted(rig).status.task_seconds == pytest.approx(1.0)
