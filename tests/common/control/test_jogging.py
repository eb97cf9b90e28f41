"""An arm that is jogged, at every cycle: how it goes, how soon it stands, and who may."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from common.config import load_cell
from common.control.executor import Executor
from common.errors import Refused
from common.hardware.interface import Limits
from common.hardware.mock import MockHardware
from common.messages import (
    ExecuteRequest,
    Header,
    HoldRequest,
    JogCommand,
    JointTrajectory,
    JointTrajectoryPoint,
    OwnRequest,
    StopRequest,
    Vector3,
)
from common.robot.model import RobotModel
from common.time_source import SystemTimeSource, use_time_source

PERIOD = 0.01
UR5_WORKS = np.array([0.0, -1.9, 1.9, -1.6, -1.57, 0.0])  # at home it stands upright: a singular place
ROBOTS = {cell: RobotModel.load(load_cell(cell).robot) for cell in ("panda", "ur5")}


@dataclass
class Moved:
    """A cell's arm, with a clock that passes when it is told to."""

    robot: RobotModel
    stamp: int = int(1.7e18)
    sent: list = field(default_factory=list)
    reports: list = field(default_factory=list)
    refused: list = field(default_factory=list)

    def __post_init__(self):
        robot, home = self.robot, self.robot.named("home") if self.robot.dof == 7 else UR5_WORKS
        self.limits = Limits(
            tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration,
            np.array(robot.config.deceleration_limits) if robot.config.deceleration_limits else None, robot.jerk)
        self.executor = Executor(MockHardware(home, None), self.limits, home, kinematics=robot)
        self.source = SystemTimeSource()
        self.source.monotonic_ns = self.source.wall_ns = lambda: self.stamp
        self.run(0.35)  # after which a stream of commands is none of before

    def step(self, seconds=PERIOD):
        self.stamp += int(seconds * 1e9)
        with use_time_source(self.source):
            self.reports.append(self.executor.cycle(Header(stamp=self.stamp)))
        self.sent.append((self.stamp * 1e-9, self.executor.arm.set_point.copy()))

    def run(self, seconds):
        for _ in range(round(seconds / PERIOD)):
            self.step()

    def jog(self, seconds, **asked):
        """Ask every 20 ms for so long; what was refused is kept by its code."""
        for k in range(round(seconds / PERIOD)):
            if k % 2 == 0:
                try:
                    with use_time_source(self.source):
                        self.executor.jog(JogCommand(**{"owner": "ann", **asked}))
                except Refused as refusal:
                    self.refused.append(refusal.code)
            self.step()

    def tool(self, seconds, linear=(0, 0, 0), angular=(0, 0, 0), **asked):
        vectors = (Vector3(x=x, y=y, z=z) for x, y, z in (linear, angular))
        self.jog(seconds, **dict(zip(("linear", "angular"), vectors, strict=True)), **asked)

    def asked(self, call, *args):
        with use_time_source(self.source):
            return call(*args)

    def own(self, act="take", owner="ann", **more):
        return self.asked(self.executor.authority.own, OwnRequest(act=act, owner=owner, **more), self.stamp * 1e-9)

    def execute(self, goal, owner="", **more):
        begin = self.q
        points = [JointTrajectoryPoint(time_from_start=t, positions=list(begin + way), velocities=[0.0] * len(begin),
                                       accelerations=[0.0] * len(begin)) for t, way in ((0.0, 0.0), (2.0, 0.2))]
        request = ExecuteRequest(id=goal, owner=owner, trajectory=JointTrajectory(
            joint_names=self.robot.joint_names, points=points), **more)
        return self.asked(self.executor.execute, request, self.stamp * 1e-9)

    @property
    def q(self):
        return self.sent[-1][1]

    @property
    def owner(self):
        return self.executor.authority.owner.owner, self.executor.authority.owner.kind

    def rests(self, seconds=0.3):
        before = self.q
        self.run(seconds)
        return np.array_equal(before, self.q)

    def judge(self):
        """The largest shares of velocity, acceleration and jerk limits between set-points."""
        q = np.array([q for _, q in self.sent])
        v, limits = np.diff(q, axis=0) / PERIOD, self.limits
        a = np.diff(v, axis=0) / PERIOD
        j = np.diff(a, axis=0) / PERIOD
        return (float((np.abs(v) / limits.velocity).max()), float((np.abs(a) / limits.braking).max()),
                float((np.abs(j) / limits.jerks).max()))


@pytest.fixture(params=ROBOTS)
def arm(request):
    return Moved(ROBOTS[request.param])


@pytest.mark.parametrize("sign", [1, -1])
def test_a_joint_goes_as_fast_as_is_asked_and_the_others_rest(arm, sign):
    joint = arm.robot.joint_names[3]
    arm.jog(0.5, joints={joint: sign * 0.2})
    before = arm.q
    arm.jog(0.5, joints={joint: sign * 0.2})
    way = arm.q - before
    assert way[3] == pytest.approx(sign * 0.1, abs=1e-6) and not np.delete(way, 3).any()


def test_the_arm_stands_a_fifth_of_a_second_after_the_newest_command(arm):
    rng = np.random.default_rng(1)
    for _ in range(20):
        dq = rng.uniform(-3, 3, arm.robot.dof)
        arm.jog(rng.uniform(0.02, 0.6), joints=dict(zip(arm.robot.joint_names, dq, strict=True)))
        arm.run(0.19)  # with the cycle of the newest command
        assert arm.rests()
    velocity, acceleration, jerk = arm.judge()
    assert velocity <= 1.0 and acceleration <= 1.001 and jerk <= 1.001


def test_whatever_is_asked_for_set_points_keep_the_limits(arm):
    rng = np.random.default_rng(2)
    lower, upper = arm.robot.lower, arm.robot.upper
    for _ in range(120):
        kind = rng.integers(3)
        if kind == 0:
            arm.jog(0.02 * rng.integers(1, 20), joints=dict(zip(
                arm.robot.joint_names, rng.uniform(-9, 9, arm.robot.dof), strict=True)))
        elif kind == 1:
            arm.tool(0.02 * rng.integers(1, 20), rng.uniform(-1, 1, 3), rng.uniform(-2, 2, 3),
                     frame=str(rng.choice(["base", "tool", "world"])))
        else:
            arm.run(0.01 * rng.integers(1, 20))
    velocity, acceleration, jerk = arm.judge()
    assert not arm.refused and velocity <= 1.0 and acceleration <= 1.001 and jerk <= 1.001
    q = np.array([q for _, q in arm.sent])
    assert (lower - q).max() < 1e-6 and (q - upper).max() < 1e-6 and np.ptp(q, axis=0).min() > 0.05


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.slow
def test_each_joint_comes_to_rest_before_its_end(arm, sign):
    for k, joint in enumerate(arm.robot.joint_names):
        arm.jog(0.2, joints={joint: sign * 9.0})
        arm.executor.authority._jogging._kinematics = None  # without the tool's own limit, faster
        arm.jog(12.0, joints={joint: sign * 9.0})
        end = arm.robot.upper[k] if sign > 0 else arm.robot.lower[k]
        assert 0 <= sign * (end - arm.q[k]) < 0.01
        arm.executor.authority._jogging._kinematics = arm.robot
    assert max(arm.judge()) <= 1.001


@pytest.mark.parametrize("frame", ["base", "tool", "world"])
@pytest.mark.parametrize("axis", range(3))
def test_the_tool_goes_straight_along_the_axis_of_the_frame(arm, frame, axis):
    arm.jog(0.2, joints={arm.robot.joint_names[0]: 0.5})  # turned away from the axes
    arm.run(0.5)
    begin = arm.robot.fk(arm.q)
    asked = np.eye(3)[axis] * 0.1
    arm.tool(0.6, asked, frame=frame)
    arm.run(0.2)
    end = arm.robot.fk(arm.q)
    way = {"tool": begin[:3, :3], "base": arm.robot.base_axes, "world": np.eye(3)}[frame] @ asked
    moved = end[:3, 3] - begin[:3, 3]
    assert moved @ way / np.linalg.norm(moved) / 0.1 > 0.9999 and 0.05 < np.linalg.norm(moved) < 0.08
    assert np.allclose(end[:3, :3], begin[:3, :3], atol=2e-3)


def test_the_tool_turns_about_itself(arm):
    begin = arm.robot.fk(arm.q)
    arm.tool(0.5, angular=(0, 0, 0.4), frame="tool")
    arm.run(0.2)
    turned = begin[:3, :3].T @ arm.robot.fk(arm.q)[:3, :3]
    assert np.linalg.norm(arm.robot.fk(arm.q)[:3, 3] - begin[:3, 3]) < 2e-3
    assert 0.1 < np.arctan2(turned[1, 0], turned[0, 0]) < 0.3


def test_the_tool_is_never_faster_than_by_hand(arm):
    arm.tool(1.0, (3.0, 0.0, 0.0))
    arm.jog(1.0, joints={arm.robot.joint_names[0]: 9.0})
    places = np.array([arm.robot.fk(q)[:3, 3] for _, q in arm.sent])
    assert 0.2 < np.linalg.norm(np.diff(places, axis=0), axis=1).max() / PERIOD <= 0.251


@pytest.mark.slow
def test_where_the_tool_can_go_no_farther_it_hardly_moves(arm):
    arm.tool(30.0, (0.2, 0.0, 0.0))
    arm.tool(0.5, (0.2, 0.0, 0.0))
    before = arm.robot.fk(arm.q)[:3, 3]
    arm.tool(0.5, (0.2, 0.0, 0.0))
    assert np.linalg.norm(arm.robot.fk(arm.q)[:3, 3] - before) < 0.02 and max(arm.judge()) <= 1.001


def test_a_command_for_nothing_brings_it_to_rest_at_once(arm):
    arm.tool(0.5, (0.1, 0.0, 0.0))
    arm.tool(0.12)
    assert arm.rests()


@pytest.mark.parametrize(("asked", "code", "told"), [
    ({"joints": {"nose": 1.0}}, "unknown_joint", "'nose' is no joint of the arm; choices: "),
    ({"joints": {}, "linear": Vector3(x=1.0)}, None, ""),
])
def test_what_cannot_be_jogged_is_refused_with_the_choices(arm, asked, code, told):
    if code is None:
        arm.asked(arm.executor.jog, JogCommand(**asked))
        return
    with pytest.raises(Refused, match=told) as refusal:
        arm.asked(arm.executor.jog, JogCommand(**asked))
    assert refusal.value.code == code


def test_joints_and_tool_together_are_a_contradiction(arm):
    with pytest.raises(Refused, match="exclude each other"):
        arm.asked(arm.executor.jog, JogCommand(joints={arm.robot.joint_names[0]: 1.0}, linear=Vector3(x=1.0)))


def test_no_goal_begins_while_the_arm_is_jogged_and_none_is_disturbed(arm):
    arm.jog(0.3, joints={arm.robot.joint_names[0]: 0.2})
    assert arm.execute("one", "ann").error == "busy"
    arm.run(0.5)
    assert arm.execute("two", "ann").state == "active"
    arm.jog(2.2, joints={arm.robot.joint_names[0]: -0.2})
    last = [report.motion for report in arm.reports if report.motion][-1]
    assert (last.id, last.state) == ("two", "succeeded") and set(arm.refused) == {"busy", "let_go"}


@pytest.mark.parametrize("end", ["stop", "hold"])
def test_after_a_stop_or_a_hold_who_keeps_asking_moves_nothing_until_they_let_go(arm, end):
    joint = {arm.robot.joint_names[0]: 0.2}
    arm.jog(0.3, joints=joint)
    if end == "stop":
        arm.asked(arm.executor.authority.stop, StopRequest(owner="bob"), arm.stamp * 1e-9)
    else:
        arm.asked(arm.executor.authority.hold, HoldRequest(hold=True, owner="bob"))
    arm.jog(0.2, joints=joint)
    before = arm.q
    arm.jog(1.0, joints=joint)
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="bob", stops=True))
    arm.jog(1.0, joints=joint)
    assert np.array_equal(arm.q, before)
    arm.run(0.35)
    arm.jog(0.3, joints=joint)
    assert not np.array_equal(arm.q, before)


def test_who_stopped_the_arm_jogs_it_and_nobody_else(arm):
    joint = {arm.robot.joint_names[0]: 0.2}
    acknowledged = arm.asked(arm.executor.authority.stop, StopRequest(owner="ann"), arm.stamp * 1e-9).newest
    arm.jog(0.3, joints=joint, owner="bob", acknowledged=acknowledged)
    arm.jog(0.3, joints=joint)
    assert arm.rests() and set(arm.refused) == {"stopped", "let_go"}
    arm.run(0.3)
    arm.jog(0.3, joints=joint, acknowledged=acknowledged)
    assert not arm.rests()


def test_of_two_that_jog_the_first_does(arm):
    arm.jog(0.2, joints={arm.robot.joint_names[0]: 0.2})
    with pytest.raises(Refused, match=r"the motion is owned by ann \(operator\)"):
        arm.asked(arm.executor.jog, JogCommand(owner="bob", joints={arm.robot.joint_names[0]: -0.2}))


def test_a_stall_of_the_executor_while_it_jogs_makes_no_step(arm):
    rng = np.random.default_rng(3)
    for _ in range(20):
        arm.jog(0.3, joints=dict(zip(arm.robot.joint_names, rng.uniform(-1, 1, arm.robot.dof), strict=True)))
        at = arm.q
        arm.step(rng.uniform(0.02, 0.5))
        assert np.all(np.abs(arm.q - at) <= PERIOD * arm.limits.velocity * 0.2)


# --- whose the motion is -------------------------------------------------------------------------------------------


def test_who_begins_a_motion_has_it_until_it_ends(arm):
    assert arm.owner == ("", "none")
    assert arm.execute("one", "ann").state == "active" and arm.owner == ("ann", "operator")
    assert arm.execute("two").error == "not_owner"
    arm.run(3.0)
    assert arm.owner == ("", "none") and arm.execute("three").state == "active" and arm.owner == ("", "task")


def test_what_was_asked_for_stays_until_it_is_given_back(arm):
    arm.own(kind="script")
    arm.run(10.0)
    assert arm.owner == ("ann", "script") and arm.execute("one", "bob").error == "not_owner"
    arm.own("give", "bob")
    assert arm.owner == ("ann", "script")
    arm.own("give")
    assert arm.owner == ("", "none") and arm.execute("two", "bob").state == "active"


def test_what_is_given_back_in_a_motion_is_nobody_elses_before_that_has_ended(arm):
    arm.own()
    assert arm.execute("one", "ann").state == "active"
    arm.run(0.3)
    arm.own("give")
    arm.step()
    assert arm.executor.arm.goal == "one" and arm.owner == ("ann", "operator")
    with pytest.raises(Refused, match=r"the motion is owned by ann \(operator\)"):
        arm.own(owner="bob")
    arm.run(3.0)
    assert arm.owner == ("", "none")
    arm.own(owner="bob")
    arm.jog(0.3, owner="bob", joints={arm.robot.joint_names[0]: 0.2})
    arm.own("give", "bob")
    assert arm.owner == ("bob", "operator"), "the arm is not at rest yet"
    arm.run(0.5)
    assert arm.owner == ("", "none")


def test_a_lease_ends_when_its_owner_says_nothing_more_but_not_in_a_motion(arm):
    arm.own(kind="script", lease=1.0)
    arm.run(0.8)
    arm.own(kind="script", lease=1.0)
    arm.run(0.8)
    assert arm.execute("one", "ann").state == "active"
    arm.run(2.0)
    assert arm.owner == ("ann", "script")
    arm.run(2.0)
    assert arm.owner == ("", "none")


def test_it_is_not_taken_from_another_unless_that_is_said(arm):
    arm.own()
    with pytest.raises(Refused, match=r"the motion is owned by ann \(operator\) since .*: take it over, if it must be"):
        arm.own(owner="bob")
    arm.own(owner="bob", over=True)
    assert arm.owner == ("bob", "operator")
    assert arm.execute("one", "ann").error == "stopped"


def test_who_takes_over_from_a_task_stops_it_for_good(arm):
    arm.own(owner="sorting", kind="task")
    arm.execute("one")
    arm.run(0.5)
    arm.own(over=True)
    arm.run(0.5)
    assert arm.rests() and arm.executor.arm.goal == ""
    assert arm.execute("two").error == "stopped"  # latched: it outlives the executor
    assert arm.executor._interlocks.record.interlocks[0].by == "ann"
    assert arm.execute("three", "ann", acknowledged=arm.stamp + 1).state == "active"
    arm.run(3.0)
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="ann", stops=True))  # she starts the task
    assert arm.owner == ("", "none") and arm.own(owner="sorting", kind="task").owner == "sorting"
    assert arm.execute("four").state == "active"


def test_a_start_by_another_does_not_take_it_from_who_has_it(arm):
    arm.own()
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="bob", stops=True))
    assert arm.owner == ("ann", "operator") and arm.execute("one").error == "not_owner"
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="bob", stops=True, override=True))
    assert arm.owner == ("", "none")


def test_motion_of_whom_a_start_takes_it_from_comes_to_rest_for_good(arm):
    arm.own()
    arm.execute("one", "ann")
    arm.run(0.5)
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="bob", stops=True, override=True))
    assert arm.own(owner="sorting", kind="task").owner == "sorting"
    arm.run(0.5)
    assert arm.rests() and arm.executor.arm.goal == "" and arm.reports[-1].owner is None
    assert arm.execute("one", "ann").state == "cancelled" and "one" in arm.executor._interlocks.record.goals
    assert arm.execute("two").state == "active"
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="bob", stops=True, override=True))
    arm.run(0.5)
    assert arm.executor.arm.goal == "two", "a task that is started once more goes on"


def test_a_start_that_comes_after_a_later_stop_takes_it_from_nobody(arm):
    said = arm.stamp
    arm.run(0.1)
    arm.own(over=True)
    arm.execute("one", "ann", acknowledged=arm.stamp + 1)
    arm.run(0.5)
    late = HoldRequest(hold=False, owner="bob", stops=True, override=True, acknowledged=said)
    arm.asked(arm.executor.authority.hold, late, arm.stamp * 1e-9)
    arm.run(0.5)
    assert arm.owner == ("ann", "operator") and arm.executor.arm.goal == "one" and not arm.rests()
    assert arm.execute("two").error == "stopped"


def test_everybodys_start_takes_it_from_who_took_it_without_a_name(arm):
    arm.own(owner="operator")
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="bob", stops=True))
    assert arm.owner == ("", "none") and arm.execute("one").state == "active"


def test_who_holds_the_arm_and_then_moves_it_does_not_take_it_from_who_has_it(arm):
    hold = arm.executor.authority.hold
    arm.own()
    arm.asked(hold, HoldRequest(hold=True, owner="bob"))
    arm.asked(hold, HoldRequest(hold=False, owner="bob", into_stop=True, acknowledged=arm.stamp + 1))
    assert arm.owner == ("ann", "operator")
    assert arm.execute("one", "bob", acknowledged=arm.stamp + 1).error == "not_owner"
    arm.own("give")
    arm.own(owner="sorting", kind="task")
    arm.asked(hold, HoldRequest(hold=False, owner="bob", into_stop=True, acknowledged=arm.stamp + 1))
    assert arm.execute("two", "bob", acknowledged=arm.stamp + 1).state == "active", "a task has it through a pause only"


def test_goal_that_was_refused_of_an_operator_and_is_asked_for_again_does_not_stop_the_task_that_was_started(arm):
    arm.own()
    assert arm.execute("one").error == "not_owner"
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="ann", stops=True))  # she starts the task
    assert arm.own(owner="sorting", kind="task").owner == "sorting"
    assert arm.execute("one").error == "not_owner"  # as before: an id stands for one answer
    assert arm.execute("two").state == "active"
    arm.run(3.0)
    arm.own("give", "sorting")
    arm.own(owner="bob")
    assert arm.execute("one").error == "not_owner" and not arm.executor.authority.interlocks.all


def test_a_stop_and_a_hold_need_no_ownership_and_a_stop_ends_it(arm):
    arm.own()
    arm.execute("one", "ann")
    arm.run(0.5)
    assert arm.asked(arm.executor.authority.hold, HoldRequest(hold=True, owner="bob"))[0].held
    arm.run(0.5)
    assert arm.rests()
    arm.asked(arm.executor.authority.stop, StopRequest(owner="bob"), arm.stamp * 1e-9)
    assert arm.owner == ("", "none")


def test_a_task_that_is_gone_has_the_motion_no_more(arm):
    arm.own(owner="sorting", kind="task")
    arm.executor.authority.disown_task()
    arm.step()
    assert arm.owner == ("", "none")
    arm.own()
    arm.executor.authority.disown_task()
    assert arm.owner == ("ann", "operator")


def test_each_change_of_it_is_told_once(arm):
    arm.reports.clear()
    arm.own()
    arm.run(0.2)
    arm.jog(0.2, joints={arm.robot.joint_names[0]: 0.2})
    arm.run(0.5)
    told = [report.owner for report in arm.reports if report.owner]
    assert [(one.owner, one.jogging) for one in told] == [("ann", False), ("ann", True), ("ann", False)]


# --- what was found by trying to break it ----------------------------------------------------------------------------


def test_the_tool_keeps_to_its_speed_and_its_line_where_a_joint_comes_to_its_end(arm):
    arm.tool(9.0, (0.0, 0.0, -0.2))
    arm.tool(5.0, (0.0, 0.0, -0.2))
    arm.run(0.5)
    places = np.array([arm.robot.fk(q)[:3, 3] for _, q in arm.sent])
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / PERIOD
    assert speeds.max() <= 0.251
    assert np.linalg.norm(places[:, :2] - places[0, :2], axis=1).max() < 0.06  # a little aside, at its limits, slowly


@pytest.mark.parametrize("seed", range(3))
def test_the_tool_is_never_faster_than_by_hand_beside_the_ends_of_joints(arm, seed):
    rng = np.random.default_rng(seed)
    names = arm.robot.joint_names
    for _ in range(25):
        if rng.random() < 0.5:
            arm.jog(0.6, joints=dict(zip(names, rng.choice([-9.0, 0.0, 9.0], len(names)), strict=True)))
        else:
            arm.tool(0.6, rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3))
        arm.run(0.2)
    places = np.array([arm.robot.fk(q)[:3, 3] for _, q in arm.sent])
    assert (np.linalg.norm(np.diff(places, axis=0), axis=1) / PERIOD).max() <= 0.27


@pytest.mark.slow
def test_where_the_tool_was_led_to_the_end_of_its_reach_it_comes_back(arm):
    arm.tool(20.0, (0.2, 0.0, 0.0))
    far = arm.robot.fk(arm.q)[0, 3]
    arm.tool(8.0, (-0.2, 0.0, 0.0))
    assert arm.robot.fk(arm.q)[0, 3] < far - 0.03


def test_a_stream_of_before_moves_nothing_when_the_executor_is_started_again(arm):
    again = Moved(arm.robot)
    again.executor = Executor(MockHardware(again.q.copy(), None), again.limits, again.q, kinematics=arm.robot)
    before = again.q
    again.jog(2.0, joints={arm.robot.joint_names[0]: 0.5})
    assert np.array_equal(again.q, before) and set(again.refused) == {"let_go"}
    again.run(0.35)
    again.jog(0.5, joints={arm.robot.joint_names[0]: 0.5})
    assert not np.array_equal(again.q, before)


@pytest.mark.parametrize("others", [0, 15, 16, 40])
def test_however_many_ask_in_vain_who_kept_asking_over_a_stop_moves_nothing(arm, others):
    joint = {arm.robot.joint_names[0]: 0.2}
    arm.jog(0.3, joints=joint)
    arm.asked(arm.executor.authority.stop, StopRequest(owner="bob"), arm.stamp * 1e-9)
    for _ in range(10):
        for k in range(others):
            with pytest.raises(Refused):
                arm.asked(arm.executor.jog, JogCommand(owner=f"other {k}", joints=joint))
        arm.jog(0.02, joints=joint)
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="bob", stops=True))
    before = arm.q
    arm.jog(0.5, joints=joint)
    assert np.array_equal(arm.q, before)
    arm.run(0.35)
    arm.jog(0.5, joints=joint)
    assert not np.array_equal(arm.q, before)


def test_what_a_dead_task_left_running_is_taken_over_too(arm):
    arm.own(owner="sorting", kind="task")
    assert arm.execute("one").state == "active"
    arm.run(0.3)
    arm.executor.authority.disown_task()
    with pytest.raises(Refused):
        arm.own(owner="bob")
    arm.own(over=True)
    arm.run(0.5)
    assert arm.rests() and arm.executor.arm.goal == ""
    arm.own("give")
    assert arm.execute("two").error == "stopped"


def test_who_takes_over_while_a_task_is_just_being_restarted_stops_it_all_the_same(arm):
    arm.own(over=True)  # the executor is new, and knows of nobody
    arm.own("give")
    assert arm.execute("one").error == "stopped"


def test_a_task_that_was_kept_from_going_on_does_not_when_the_motion_is_given_back(arm):
    arm.own()
    assert arm.execute("one").error == "not_owner"
    arm.own("give")
    assert arm.execute("two").error == "stopped"
    assert arm.execute("three", "bob").error == "stopped"
    arm.asked(arm.executor.authority.hold, HoldRequest(hold=False, owner="bob", stops=True))
    assert arm.execute("four").state == "active"
