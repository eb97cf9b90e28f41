"""The executor's cycle: gripper and world, faults of devices, holds for a goal, restarts."""

import numpy as np
import pytest

from common.config import World
from common.control.executor import Executor
from common.errors import ConfigError, Refused
from common.hardware.interface import GripperReading, HardwareFault
from common.hardware.lag import LagHardware
from common.hardware.mock import MockHardware, SimulatedFingers
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    GripperState,
    Header,
    HoldRequest,
    MotionStatus,
    StopRequest,
    Vector3,
    WorldEdit,
    WorldObjects,
)
from common.sim.interface import ObjectSnapshot
from common.sim.kinematic import KinematicWorld
from common.transport.codec import decode, encode
from tests.common.control.rig import GRIPPER, START, TABLE, ExecutorRig, mock

FAR = [0.5, 0.5]


@pytest.fixture
def rig(limits):
    rig = ExecutorRig(limits)
    rig.step()
    return rig


def test_first_cycle_reports_everything_and_later_ones_only_the_joints(rig):
    assert rig.motions[0].state == "none" and rig.grippers[0].width == 0.08 and rig.balls[0].ids == ["ball_1"]
    assert rig.joints[0].name == ["shoulder", "elbow", "left", "right"]
    assert rig.joints[0].position == [0, 0, 0.04, 0.04] and rig.joints[0].header.stamp == rig.stamp
    rig.run(1.0)
    assert (len(rig.motions), len(rig.grippers), len(rig.balls), len(rig.joints)) == (1, 1, 1, 101)


# --- gripper and world ---


@pytest.mark.parametrize("make", [MockHardware, lambda start, fingers: LagHardware(start, 0.03, fingers)])
def test_ball_is_grasped_lifted_carried_and_released(limits, rest_to_rest, make):
    rig = ExecutorRig(limits, make(START, SimulatedFingers(GRIPPER)))
    rig.step()
    assert rig.grip("close", 0.0).state == "active"
    rig.run(1.0)
    assert rig.grippers[-1].holding and rig.grippers[-1].state == "succeeded"
    assert rig.grippers[-1].width == pytest.approx(0.06) and rig.updates == ["remove:ball_1"]
    rig.execute("lift", rest_to_rest([0, 0], [-0.2, 0.2]))
    rig.run(1.5)
    assert rig.motions[-1].state == "succeeded" and rig.balls[-1].labels == ["held"]
    assert rig.balls[-1].poses[0].position.z == pytest.approx(0.23, abs=2e-3)
    rig.grip("open", 0.08)
    rig.run(1.0)
    assert not rig.grippers[-1].holding and rig.balls[-1].labels == ["table"]
    assert rig.balls[-1].poses[0].position.x == pytest.approx(0.3, abs=2e-3)
    assert rig.updates == ["remove:ball_1", "add:ball_1"]


def test_fingers_that_close_on_nothing_succeed_without_holding(limits):
    rig = ExecutorRig(limits, balls=[(0.8, 0.0)])
    rig.grip("close", 0.0)
    rig.run(1.0)
    state = rig.grippers[-1]
    assert (state.id, state.state, state.holding, state.width) == ("close", "succeeded", False, 0.0)


def test_ball_taken_from_the_fingers_is_reported(rig):
    rig.grip("close", 0.0)
    rig.run(1.0)
    rig.cell.edit(WorldEdit(op="move", id="ball_1", position=Vector3(x=0.3)), rig.now)
    rig.run(1.0)
    assert not rig.grippers[-1].holding and rig.grippers[-1].width == 0.0


@pytest.mark.parametrize(("expected", "state", "outcome"), [
    (0.058, "succeeded", "grasped"), (0.04, "aborted", "too_wide"), (0.075, "aborted", "too_narrow")])
def test_grasp_is_checked_by_the_width_of_the_object(rig, expected, state, outcome):
    rig.grip("close", 0.0, expected_width=expected)
    rig.run(1.0)
    found = rig.grippers[-1]
    assert (found.state, found.outcome, found.holding, found.effort) == (state, outcome, True, GRIPPER.effort)
    rig.cell.edit(WorldEdit(op="drop", id="ball_1"), rig.now)
    rig.run(1.0)
    found = rig.grippers[-1]
    assert not found.holding and found.outcome == ("slipping" if state == "succeeded" else outcome)


def test_repeated_gripper_id_moves_nothing(rig):
    for goal, width in (("close", 0.0), ("open", 0.08)):
        rig.grip(goal, width)
        rig.run(1.0)
    again = rig.grip("close", 0.0)
    assert (again.id, again.state) == ("close", "succeeded")
    rig.run(0.5)
    assert rig.grippers[-1].width == 0.08 and rig.grippers[-1].id == "open"


def test_new_gripper_command_replaces_the_running_one(rig):
    rig.grip("close", 0.0)
    rig.run(0.1)
    rig.grip("open", 0.08)
    assert rig.grip("close", 0.0).state == "cancelled" and "open" in rig.grip("close", 0.0).message
    rig.run(1.0)
    assert (rig.grippers[-1].id, rig.grippers[-1].state) == ("open", "succeeded")


def test_width_beyond_the_fingers_is_rejected(rig):
    answer = rig.grip("wide", 0.1)
    assert answer.state == "rejected" and "0.08" in answer.message
    rig.run(0.5)
    assert rig.grippers[-1].id == "" and rig.grippers[-1].width == 0.08


def test_arm_without_gripper_refuses_gripper_commands(limits):
    executor = Executor(MockHardware(START, None), limits, START)
    with pytest.raises(Refused, match="no gripper"):
        executor.command_gripper(GripperCommand(id="close", width=0.0), 1.0)
    report = executor.cycle(Header(stamp=1))
    assert report.gripper is None and report.joints is not None and len(report.joints.name) == 2


def test_executor_works_without_a_world(limits):
    executor = Executor(mock(), limits, START, gripper=GRIPPER)
    executor.restore(1.0)
    executor.command_gripper(GripperCommand(id="close", width=0.0), 1.0)
    for tick in range(200):
        report = executor.cycle(Header(stamp=int(1e9 + tick * 1e7)))
        assert report.objects is None and not report.updates
    assert report.joints is not None and report.joints.position[2:] == [0, 0]


class NumbFingers:
    """Simulated fingers that objects cannot block."""

    def command(self, width, now, effort):
        pass

    def read(self, now):
        raise AssertionError


@pytest.mark.parametrize("fingers", [None, NumbFingers()])
def test_backend_with_an_unsuitable_gripper_is_a_configuration_error(limits, fingers):
    with pytest.raises(ConfigError, match=r"robot\.hardware\.backend"):
        ExecutorRig(limits, MockHardware(START, fingers))


def test_long_step_of_the_world_is_deferred_and_the_arm_continues(limits, monkeypatch):
    class SlowWorld(KinematicWorld):
        def takes_long(self, width, gripping):
            return gripping and not self.held

    rig = ExecutorRig(limits, world=SlowWorld(World(fixtures=[TABLE], balls=[(0.5, 0.0)])))
    rig.cell.defers_steps = True
    rig.step()
    rig.grip("close", 0.0)
    while rig.cell.deferred is None:
        rig.step()
    before, saved = len(rig.joints), len(rig.saver.states)
    with monkeypatch.context() as patched:
        for name in ("tick", "obstruction", "objects", "take_events", "snapshot"):
            owner = next(cls for cls in KinematicWorld.__mro__ if name in vars(cls))
            patched.delattr(owner, name)  # any call would fail
        rig.run(0.2)
        assert len(rig.joints) == before + 20 and len(rig.saver.states) == saved
    rig.cell.deferred()
    rig.cell.deferred, rig.cell.suspended = None, False
    rig.step()
    assert rig.world.held == "ball_1" and len(rig.saver.states) == saved + 1


# --- restarts of simulated hardware ---


def test_unchanged_objects_are_not_saved_again_while_the_arm_moves(rig, rest_to_rest):
    rig.execute("a", rest_to_rest([0, 0], [0, 0.1]))
    rig.run(0.2)
    first = rig.saved
    rig.step()
    second = rig.saved
    assert first.q != second.q and first.objects is second.objects and first.layout is second.layout


def test_objects_of_physics_are_saved_as_of_the_same_moment_as_the_arm(limits, rest_to_rest):
    class Recorded(MockHardware):
        def read(self, now):
            self.last = super().read(now)
            return self.last

    class Physics:
        version, ids, layout, held = 1, [], {}, "ball"  # it reports moving objects only now and then

        def snapshot(self):
            return {"ball": ObjectSnapshot(pose=tuple(hardware.last[0]))}

        def objects(self, header):
            return WorldObjects(header=header)

        def take_events(self):
            return []

    hardware = Recorded(START, SimulatedFingers(GRIPPER))
    rig = ExecutorRig(limits, hardware, world=Physics())
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], [0, 0.1]))
    for _ in range(3):
        rig.run(0.1)
        assert rig.saved.q == list(rig.saved.objects["ball"].pose) and rig.saved.q[1] > 0


def test_held_object_is_pressed_as_before_a_restart_and_watched(limits, rig):
    rig.grip("close", 0.0, effort=40.0)
    rig.run(1.0)
    again = rig.restarted(limits)
    assert again.cell.restored
    again.run(0.5)
    found = again.grippers[-1]
    assert (found.id, found.holding, found.effort, found.outcome) == ("", True, 40.0, "grasped")
    again.cell.edit(WorldEdit(op="drop", id="ball_1"), again.now)
    again.run(1.0)
    assert again.grippers[-1].outcome == "slipping"


@pytest.mark.parametrize("held", [False, True])
def test_stopped_fingers_stay_where_they_were_before_a_restart_and_keep_pressing(limits, rig, held):
    rig.grip("close", 0.0, effort=40.0)
    rig.run(1.0 if held else 0.05)
    width = rig.grippers[-1].width
    again = rig.restarted(limits, StopRequest(owner="anna"))
    again.run(1.0)
    found = again.grippers[-1]
    assert found.holding == held and found.width == pytest.approx(width, abs=2e-3)
    if held:
        assert found.effort == 40.0


def test_fingers_without_a_command_stay_where_they_were_before_a_restart(limits):
    rig = ExecutorRig(limits)
    rig.run(0.1)
    assert rig.saved.width == 0.08
    again = ExecutorRig(limits, mock(width=0.05), persisted=rig.saved)
    again.executor.restore(again.now)
    again.run(1.0)
    assert {state.width for state in again.grippers} == {0.08}


# --- goals ---


def test_progress_is_reported_about_ten_times_a_second(rig, rest_to_rest):
    rig.execute("a", rest_to_rest([0, 0], FAR, 2.0))
    rig.run(2.5)
    reports = [m for m in rig.motions if m.id == "a"]
    assert reports[0].state == "active" and reports[-1].state == "succeeded" and 19 <= len(reports) <= 24
    assert [m.progress for m in reports] == sorted(m.progress for m in reports)


def test_stop_reports_cancelled(rig, rest_to_rest):
    rig.execute("a", rest_to_rest([0, 0], FAR, 2.0))
    rig.run(1.0)
    assert rig.executor.authority.stop(StopRequest(id="a", reason="enough"), rig.now).state == "active"
    rig.run(0.5)
    assert (rig.motions[-1].state, rig.motions[-1].message) == ("cancelled", "enough")
    assert not any(rig.joints[-1].velocity)


def test_nothing_moves_before_the_first_joint_reading(limits, rest_to_rest):
    rig = ExecutorRig(limits, mock(np.array([0.5, 0.0])))
    answer = rig.execute("a", rest_to_rest([0, 0], [0.2, 0.2]))
    assert (answer.error, answer.message) == ("hardware_fault", "no joint reading received yet")
    rig.step()
    assert rig.execute("b", rest_to_rest([0.5, 0], [0.2, 0.2])).state == "active"


def obstructed(goal, hold=True):
    return HoldRequest(hold=hold, reason="mug obstructs hand", by="scene_monitor", goal=goal)


def test_hold_for_a_goal_holds_only_that_goal_and_ends_with_it(rig, rest_to_rest):
    trajectory, authority = rest_to_rest([0, 0], [0.3, 0.3]), rig.executor.authority
    assert rig.execute("a", trajectory).state == "active"
    rig.run(0.3)
    assert authority.hold(obstructed("a"))[0].held_by == ["scene_monitor"]
    rig.run(2.0)
    status = rig.motions[-1]
    assert status.state == "active" and not status.paused and "held: mug obstructs hand" in status.message
    assert [(one.by, one.reason) for one in status.interlocks] == [("scene_monitor", "mug obstructs hand")]
    authority.stop(StopRequest(id="a", by="requester"), rig.now)
    rig.run(0.5)
    assert (rig.motions[-1].state, rig.motions[-1].held) == ("cancelled", False)
    assert rig.execute("b", trajectory).state == "rejected", "the arm is not at its start any more"
    assert not authority.hold(obstructed("a"))[0].held, "that goal is over"


def test_scene_monitor_and_operator_release_only_their_own_holds(rig, rest_to_rest):
    authority = rig.executor.authority
    rig.execute("a", rest_to_rest([0, 0], [0.3, 0.3]))
    authority.hold(HoldRequest(hold=True, owner="anna"))
    authority.hold(obstructed("a"))
    authority.hold(obstructed("a", hold=False))
    rig.run(1.0)
    assert rig.motions[-1].held_by == ["operator"] and rig.motions[-1].progress < 0.1
    authority.hold(obstructed("a"))
    authority.hold(HoldRequest(hold=False, owner="anna"))
    rig.run(1.0)
    assert rig.motions[-1].held_by == ["scene_monitor"]


def test_goal_reports_its_plan_and_its_request_can_be_read_while_it_is_followed(rig, rest_to_rest):
    request = ExecuteRequest(id="a", trajectory=rest_to_rest([0, 0], [0.3, 0.3]), plan="p", scene_stamp=7)
    rig.executor.execute(request, rig.now)
    rig.step()
    assert (rig.motions[-1].plan, rig.motions[-1].scene_stamp) == ("p", 7)
    assert rig.executor.followed("a") == request
    for goal in ("b", ""):
        with pytest.raises(Refused, match=f"goal '{goal}' is not followed now"):
            rig.executor.followed(goal)
    rig.run(5.0)
    with pytest.raises(Refused):
        rig.executor.followed("a")


# --- faults of devices ---


class Broken(MockHardware):
    """Hardware whose method `failing` raises `error`, and which counts that."""

    def __init__(self):
        super().__init__(START, SimulatedFingers(GRIPPER))
        self.failing, self.error, self.failed = "", None, 0

    def call(self, method):
        if method == self.failing:
            self.failed += 1
            raise self.error

    def read(self, now):
        self.call("read")
        return super().read(now)

    def write(self, positions, velocities, now):
        self.call("write")
        super().write(positions, velocities, now)


@pytest.mark.parametrize("failing", ["read", "write"])
@pytest.mark.parametrize("error", [
    HardwareFault("cable is off"), HardwareFault(), OSError(5, "no route"), KeyError("q"), TypeError()])
def test_failing_backend_is_left_alone_and_recovers_by_itself(limits, rest_to_rest, failing, error):
    rig = ExecutorRig(limits, hardware := Broken())
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], FAR))
    rig.run(0.3)
    hardware.failing, hardware.error = failing, error
    notes = rig.run(1.0)
    assert hardware.failed <= 4 and len(notes) == 1 and notes[0].startswith("the arm does not work: ")
    aborted = rig.motions[-1]
    assert (aborted.state, aborted.error, aborted.source) == ("aborted", "hardware_fault", "hardware")
    assert aborted.message and aborted.message in notes[0]
    refused = rig.execute("b", rest_to_rest([0, 0], FAR))
    assert refused.error == "hardware_fault" and refused.message in notes[0]
    if failing == "read":
        assert rig.step().joints is None, "no invented joint state"
    rig.run(30.0)
    assert hardware.failed <= 12
    hardware.failing = ""
    hardware._positions, hardware._velocities = np.array([0.3, -0.2]), START  # it has sagged meanwhile
    notes = rig.run(6.0)
    assert len(notes) == 1 and notes[0].startswith("the arm works again")
    assert rig.joints[-1].position[:2] == [0.3, -0.2] and not any(rig.joints[-1].velocity[:2])
    assert rig.execute("c", rest_to_rest([0.3, -0.2], FAR)).state == "active"


NOT_TWO = "reading joints: positions are not 2 finite numbers"


@pytest.mark.parametrize(("reading", "says"), [
    ((np.zeros(3), START), NOT_TWO), ((np.array([np.nan, 0.0]), START), NOT_TWO),
    ((np.array([1e300, 0.0]), START), NOT_TWO), ((None, START), NOT_TWO), (([None, 0.0], START), NOT_TWO),
    (None, "reading joints: "), ((START,), "reading joints: "), ((["a", "b"], START), "reading joints: "),
])
def test_invalid_joint_reading_is_a_fault_and_moves_nothing(limits, reading, says):
    rig = ExecutorRig(limits, hardware := Broken())
    rig.step()
    hardware.read = lambda now: reading
    report = rig.step()
    assert report.notes[0].startswith(f"the arm does not work: {says}") and report.joints is None
    assert "hardware fault" in rig.motions[-1].message


@pytest.mark.parametrize("device", ["arm", "gripper"])
def test_message_of_a_fault_with_any_characters_can_be_sent(limits, rest_to_rest, monkeypatch, device):
    rig = ExecutorRig(limits)
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], FAR, 2.0))
    rig.grip("close", 0.0)

    def fail(*_):
        raise HardwareFault(b"\xff\x1b[2J".decode(errors="surrogateescape"))

    monkeypatch.setattr(rig.hardware if device == "arm" else rig.hardware.gripper, "read", fail)
    rig.run(1.0)
    status = decode(MotionStatus, encode(rig.motions[-1]))
    assert status.message == r"\udcff\x1b[2J" and status == rig.motions[-1]
    assert decode(GripperState, encode(rig.grippers[-1])) == rig.grippers[-1]


@pytest.mark.parametrize("reading", [
    GripperReading(np.nan, 0.0, False, False), GripperReading(0.05, np.inf, True, False), None,
    GripperReading(0.05, 0.0, False, False, np.inf), GripperReading(None, 0.0, False, False),
])
def test_invalid_gripper_reading_is_a_fault_of_the_gripper(limits, rest_to_rest, monkeypatch, reading):
    rig = ExecutorRig(limits)
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], FAR, 2.0))
    with monkeypatch.context() as broken:
        broken.setattr(rig.hardware.gripper, "read", lambda now: reading)
        notes = rig.run(1.0)
        assert len(notes) == 1 and notes[0].startswith("the gripper does not work: reading the gripper: ")
        assert (rig.motions[-1].state, rig.motions[-1].error) == ("aborted", "hardware_fault")
    rig.run(6.0)
    assert rig.grip("again", 0.08).state == "active"


def test_numpy_numbers_are_valid_gripper_readings(limits, monkeypatch):
    rig = ExecutorRig(limits)
    reading = GripperReading(np.float32(0.05), np.float32(0.0), np.bool_(False), np.bool_(True), np.float32(1.0))
    monkeypatch.setattr(rig.hardware.gripper, "read", lambda now: reading)
    rig.step()
    assert decode(GripperState, encode(rig.grippers[-1])).width == pytest.approx(0.05)


def test_failing_gripper_brakes_the_arm_which_is_held_and_refuses_goals(limits, rest_to_rest, monkeypatch):
    rig = ExecutorRig(limits, Broken())
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], FAR, 2.0))
    rig.run(0.2)
    rig.grip("close", 0.0)
    rig.run(0.1)

    def fail(*_):
        raise TimeoutError("no answer")

    def fail_without_a_message(*_):
        raise HardwareFault

    with monkeypatch.context() as broken:
        broken.setattr(rig.hardware.gripper, "read", fail)
        assert rig.run(1.0) == ["the gripper does not work: reading the gripper: TimeoutError: no answer"]
        for state in (rig.motions[-1], rig.grippers[-1]):
            assert (state.state, state.error) == ("aborted", "hardware_fault")
        assert 0 < rig.joints[-1].position[0] < 0.2 and not any(rig.joints[-1].velocity[:2])
        assert rig.execute("b", rest_to_rest(rig.joints[-1].position[:2], FAR)).error == "hardware_fault"
        assert rig.grip("open", 0.08).error == "hardware_fault"
    for goal, failing, message in (("again", fail, "moving the gripper: TimeoutError: no answer"),
                                   ("still", fail_without_a_message, "moving the gripper: HardwareFault")):
        rig.run(6.0)
        with monkeypatch.context() as broken:
            broken.setattr(rig.hardware.gripper, "command", failing)
            assert rig.grip(goal, 0.08).message == message
    rig.run(6.0)
    assert rig.grip("now", 0.08).state == "active"
    assert rig.execute("c", rest_to_rest(rig.joints[-1].position[:2], FAR)).state == "active"
