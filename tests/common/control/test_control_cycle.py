import numpy as np
import pytest

from applications.pick_place.topics import scene_balls
from common.config import Fixture, GripperConfig, World
from common.control.cycle import ControlCycle
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
from common.robot.transforms import tool_down
from common.sim.interface import StandingObject
from common.sim.kinematic import KinematicWorld
from common.transport.codec import decode, encode

START = np.zeros(2)
GRIPPER = GripperConfig(joints=["left", "right"], links=[])
TABLE = Fixture(id="table", dimensions=[1.0, 1.0, 0.05], position=(0.5, 0.0, -0.025))


class Gantry:
    """A hand over the table that the two joints move along x and z from (0.5, 0, 0.03)."""

    def fk(self, q):
        return tool_down(0.5 + q[0], 0.0, 0.03 + q[1])


class Rig:
    def __init__(self, limits, hardware=None, balls=((0.5, 0.0),), **changes):
        self.hardware = hardware or MockHardware(START, SimulatedFingers(GRIPPER, 0.08))
        config = World(fixtures=[TABLE], balls=list(balls))
        self.world = KinematicWorld(config)
        given = {"gripper": GRIPPER, "kinematics": Gantry(), "world": self.world, **changes}
        self.cycle = ControlCycle(self.hardware, limits, START, **given)
        self.stamp = int(1.7e18)
        self.motions, self.grippers, self.updates, self.balls, self.joints = [], [], [], [], []

    @property
    def now(self):
        return self.stamp * 1e-9

    def step(self, seconds=0.01):
        self.stamp += int(seconds * 1e9)
        report = self.cycle.step(Header(stamp=self.stamp, frame_id="world"))
        self.motions += [report.motion] if report.motion else []
        self.grippers += [report.gripper] if report.gripper else []
        self.balls += [scene_balls(report.objects)] if report.objects else []
        self.joints += [report.joints] if report.joints else []
        self.updates += [update.data for update in report.updates]
        return report

    def run(self, seconds):
        for _ in range(round(seconds / 0.01)):
            self.step()

    def execute(self, goal, trajectory):
        return self.cycle.execute(ExecuteRequest(id=goal, trajectory=trajectory), self.now)

    def grip(self, goal, width):
        return self.cycle.command(GripperCommand(id=goal, width=width), self.now)


@pytest.fixture
def rig(limits):
    made = Rig(limits)
    made.step()
    return made


def test_what_stands_still_while_the_arm_moves_is_written_down_once(rig, rest_to_rest):
    rig.execute("a", rest_to_rest([0, 0], [0, 0.1]))
    rig.run(0.2)
    first = rig.cycle.standing()
    rig.step()
    second = rig.cycle.standing()
    assert first.q != second.q and first.objects is second.objects and first.layout is second.layout


def test_what_physics_moves_with_the_arm_is_written_down_as_of_the_same_moment(limits, rest_to_rest):
    class Physics:
        version, ids, layout, held = 1, [], {}, "ball"  # it tells of what moves now and then only

        def standing(self):
            return {"ball": StandingObject(pose=tuple(rig.joints[-1].position))}

        def objects(self, header):
            return WorldObjects(header=header)

        def take_events(self):
            return []

    rig = Rig(limits, world=Physics())
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], [0, 0.1]))
    for _ in range(3):
        rig.run(0.1)
        kept = rig.cycle.standing()
        assert kept.q == list(kept.objects["ball"].pose[:2]) and kept.q[1] > 0


def test_first_cycle_tells_everything_and_then_only_the_joints(rig):
    assert rig.motions[0].state == "none" and rig.grippers[0].width == 0.08 and rig.balls[0].ids == ["ball_1"]
    assert rig.joints[0].name == ["shoulder", "elbow", "left", "right"]
    assert rig.joints[0].position == [0, 0, 0.04, 0.04] and rig.joints[0].header.stamp == rig.stamp
    rig.run(1.0)
    assert (len(rig.motions), len(rig.grippers), len(rig.balls), len(rig.joints)) == (1, 1, 1, 101)


@pytest.mark.parametrize("make", [MockHardware, lambda start, fingers: LagHardware(start, 0.03, fingers)])
def test_ball_is_grasped_lifted_carried_and_let_go(limits, rest_to_rest, make):
    rig = Rig(limits, make(START, SimulatedFingers(GRIPPER, 0.08)))
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


def test_fingers_that_close_on_air_succeed_without_holding(limits):
    rig = Rig(limits, balls=[(0.8, 0.0)])
    rig.grip("close", 0.0)
    rig.run(1.0)
    state = rig.grippers[-1]
    assert (state.id, state.state, state.holding, state.width) == ("close", "succeeded", False, 0.0)


def test_ball_taken_from_the_fingers_is_reported(rig):
    rig.grip("close", 0.0)
    rig.run(1.0)
    rig.cycle.edit(WorldEdit(op="move", id="ball_1", position=Vector3(x=0.3)), rig.now)
    rig.run(1.0)
    assert not rig.grippers[-1].holding and rig.grippers[-1].width == 0.0


@pytest.mark.parametrize(("expected", "state", "outcome"), [
    (0.058, "succeeded", "grasped"), (0.04, "aborted", "too_wide"), (0.075, "aborted", "too_narrow")])
def test_grasp_is_checked_against_what_the_world_puts_between_the_fingers(rig, expected, state, outcome):
    rig.cycle.command(GripperCommand(id="close", width=0.0, expected_width=expected), rig.now)
    rig.run(1.0)
    told = rig.grippers[-1]
    assert (told.state, told.outcome, told.holding, told.effort) == (state, outcome, True, GRIPPER.effort)
    rig.cycle.edit(WorldEdit(op="drop", id="ball_1"), rig.now)
    rig.run(1.0)
    told = rig.grippers[-1]
    assert not told.holding and told.outcome == ("slipping" if state == "succeeded" else outcome)


def test_after_a_restart_what_is_held_is_pressed_as_before_and_watched(limits, rig):
    rig.cycle.command(GripperCommand(id="close", width=0.0, effort=40.0), rig.now)
    rig.run(1.0)
    again = Rig(limits)
    again.stamp = rig.stamp
    again.cycle.restore(rig.cycle.standing(), again.now)
    again.run(0.5)
    told = again.grippers[-1]
    assert (told.id, told.holding, told.effort, told.outcome) == ("", True, 40.0, "grasped")
    again.cycle.edit(WorldEdit(op="drop", id="ball_1"), again.now)
    again.run(1.0)
    assert again.grippers[-1].outcome == "slipping"


@pytest.mark.parametrize("held", [False, True])
def test_after_a_restart_fingers_that_a_stop_forbids_to_move_stay_where_they_are_and_press(limits, rig, held):
    rig.cycle.command(GripperCommand(id="close", width=0.0, effort=40.0), rig.now)
    rig.run(1.0 if held else 0.05)
    width = rig.grippers[-1].width
    again = Rig(limits)
    again.stamp = rig.stamp
    again.cycle.authority.stop(StopRequest(owner="anna"), again.now)
    again.cycle.restore(rig.cycle.standing(), again.now)
    again.run(1.0)
    told = again.grippers[-1]
    assert told.holding == held and told.width == pytest.approx(width, abs=2e-3)
    if held:
        assert told.effort == 40.0


def test_same_gripper_id_again_moves_nothing(rig):
    rig.grip("close", 0.0)
    rig.run(1.0)
    rig.grip("open", 0.08)
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


def test_width_that_the_fingers_do_not_have_is_rejected(rig):
    answer = rig.grip("wide", 0.1)
    assert answer.state == "rejected" and "0.08" in answer.message
    rig.run(0.5)
    assert rig.grippers[-1].id == "" and rig.grippers[-1].width == 0.08


def test_progress_is_told_about_ten_times_a_second(rig, rest_to_rest):
    rig.execute("a", rest_to_rest([0, 0], [0.5, 0.5], 2.0))
    rig.run(2.5)
    told = [m for m in rig.motions if m.id == "a"]
    assert told[0].state == "active" and told[-1].state == "succeeded" and 19 <= len(told) <= 24
    assert [m.progress for m in told] == sorted(m.progress for m in told)


def test_stop_reports_cancelled(rig, rest_to_rest):
    rig.execute("a", rest_to_rest([0, 0], [0.5, 0.5], 2.0))
    rig.run(1.0)
    assert rig.cycle.authority.stop(StopRequest(id="a", reason="enough"), rig.now).state == "active"
    rig.run(0.5)
    assert (rig.motions[-1].state, rig.motions[-1].message) == ("cancelled", "enough")
    assert not any(rig.joints[-1].velocity)


def test_fault_of_the_hardware_is_reported_and_survived(limits, rest_to_rest):
    class Flaky(MockHardware):
        broken = False

        def read(self, now):
            if self.broken:
                raise HardwareFault("cable is off")
            return super().read(now)

    hardware = Flaky(START, SimulatedFingers(GRIPPER, 0.08))
    rig = Rig(limits, hardware)
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], [0.5, 0.5]))
    rig.run(0.3)
    hardware.broken = True
    rig.run(0.3)
    assert (rig.motions[-1].state, rig.motions[-1].source) == ("aborted", "hardware")
    assert rig.execute("b", rest_to_rest([0, 0], [0.5, 0.5])).error == "hardware_fault"
    assert rig.step().joints is None, "nothing is invented"
    hardware.broken = False
    rig.run(0.5)
    here = rig.joints[-1].position[:2]
    assert rig.execute("c", rest_to_rest(here, [0.5, 0.5])).state == "active"


class Broken(MockHardware):
    """Hardware that raises what it is given, and counts how often it is asked in vain."""

    def __init__(self):
        super().__init__(START, SimulatedFingers(GRIPPER, 0.08))
        self.failing, self.error, self.failed = "", None, 0

    def ask(self, what):
        if what == self.failing:
            self.failed += 1
            raise self.error

    def read(self, now):
        self.ask("read")
        return super().read(now)

    def write(self, positions, velocities, now):
        self.ask("write")
        super().write(positions, velocities, now)


@pytest.mark.parametrize("failing", ["read", "write"])
@pytest.mark.parametrize("error", [
    HardwareFault("cable is off"), HardwareFault(), OSError(5, "no route"), KeyError("q"), TypeError()])
def test_whatever_a_backend_raises_it_is_left_alone_and_recovers_by_itself(limits, rest_to_rest, failing, error):
    hardware = Broken()
    rig = Rig(limits, hardware)
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], [0.5, 0.5]))
    rig.run(0.3)
    hardware.failing, hardware.error = failing, error
    notes = [note for _ in range(100) for note in rig.step().notes]
    assert hardware.failed <= 4 and len(notes) == 1 and notes[0].startswith("the arm does not work: ")
    assert (rig.motions[-1].state, rig.motions[-1].error) == ("aborted", "hardware_fault")
    assert rig.motions[-1].message and rig.motions[-1].message in notes[0]
    refused = rig.execute("b", rest_to_rest([0, 0], [0.5, 0.5]))
    assert refused.error == "hardware_fault" and refused.message in notes[0]
    rig.run(30.0)
    assert hardware.failed <= 12
    hardware.failing = ""
    hardware._positions, hardware._velocities = np.array([0.3, -0.2]), START  # it sagged meanwhile
    notes = [note for _ in range(600) for note in rig.step().notes]
    assert len(notes) == 1 and notes[0].startswith("the arm works again")
    assert rig.joints[-1].position[:2] == [0.3, -0.2] and not any(rig.joints[-1].velocity[:2])
    assert rig.execute("c", rest_to_rest([0.3, -0.2], [0.5, 0.5])).state == "active"


@pytest.mark.parametrize("strange", [np.zeros(3), np.array([np.nan, 0.0]), np.array([1e300, 0.0]), None, [None, 0.0]])
def test_what_is_no_position_is_a_fault_and_moves_nothing(limits, strange):
    hardware = Broken()
    rig = Rig(limits, hardware)
    rig.step()
    hardware.read = lambda now: (strange, START)
    report = rig.step()
    assert "reading joints: positions are not 2 finite numbers" in report.notes[0] and report.joints is None
    assert "hardware fault" in rig.motions[-1].message


@pytest.mark.parametrize("part", ["arm", "fingers"])
def test_whatever_a_device_says_of_its_fault_can_be_told(limits, rest_to_rest, monkeypatch, part):
    rig = Rig(limits)
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], [0.5, 0.5], 2.0))
    rig.grip("close", 0.0)

    def fail(*_):
        raise HardwareFault(b"\xff\x1b[2J".decode(errors="surrogateescape"))

    monkeypatch.setattr(rig.hardware if part == "arm" else rig.hardware.gripper, "read", fail)
    rig.run(1.0)
    told = decode(MotionStatus, encode(rig.motions[-1]))
    assert told.message == r"\udcff\x1b[2J" and told == rig.motions[-1]
    assert decode(GripperState, encode(rig.grippers[-1])) == rig.grippers[-1]


@pytest.mark.parametrize("strange", [None, (START,), (["a", "b"], START)])
def test_what_is_no_reading_of_joints_at_all_is_a_fault(limits, strange):
    hardware = Broken()
    rig = Rig(limits, hardware)
    rig.step()
    hardware.read = lambda now: strange
    assert rig.step().notes[0].startswith("the arm does not work: reading joints: ")


@pytest.mark.parametrize("strange", [
    GripperReading(np.nan, 0.0, False, False), GripperReading(0.05, np.inf, True, False), None,
    GripperReading(0.05, 0.0, False, False, np.inf), GripperReading(None, 0.0, False, False),
])
def test_what_is_no_reading_of_fingers_is_a_fault_of_the_gripper(limits, rest_to_rest, monkeypatch, strange):
    rig = Rig(limits)
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], [0.5, 0.5], 2.0))
    with monkeypatch.context() as broken:
        broken.setattr(rig.hardware.gripper, "read", lambda now: strange)
        notes = [note for _ in range(100) for note in rig.step().notes]
        assert len(notes) == 1 and notes[0].startswith("the gripper does not work: reading the gripper: ")
        assert (rig.motions[-1].state, rig.motions[-1].error) == ("aborted", "hardware_fault")
    rig.run(6.0)
    assert rig.grip("again", 0.08).state == "active"


def test_numbers_of_numpy_are_readings_of_fingers_too(limits, monkeypatch):
    rig = Rig(limits)
    said = GripperReading(np.float32(0.05), np.float32(0.0), np.bool_(False), np.bool_(True), np.float32(1.0))
    monkeypatch.setattr(rig.hardware.gripper, "read", lambda now: said)
    rig.step()
    assert decode(GripperState, encode(rig.grippers[-1])).width == pytest.approx(0.05)


def test_gripper_that_fails_brakes_the_arm_which_stays_held_and_refuses_goals(limits, rest_to_rest, monkeypatch):
    rig = Rig(limits, Broken())
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], [0.5, 0.5], 2.0))
    rig.run(0.2)
    rig.grip("close", 0.0)
    rig.run(0.1)

    def fail(*_):
        raise TimeoutError("no answer")

    def fail_without_a_word(*_):
        raise HardwareFault

    with monkeypatch.context() as broken:
        broken.setattr(rig.hardware.gripper, "read", fail)
        notes = [note for _ in range(100) for note in rig.step().notes]
        assert notes == ["the gripper does not work: reading the gripper: TimeoutError: no answer"]
        assert (rig.motions[-1].state, rig.motions[-1].error) == ("aborted", "hardware_fault")
        assert (rig.grippers[-1].state, rig.grippers[-1].error) == ("aborted", "hardware_fault")
        assert 0 < rig.joints[-1].position[0] < 0.2 and not any(rig.joints[-1].velocity[:2])
        assert rig.execute("b", rest_to_rest(rig.joints[-1].position[:2], [0.5, 0.5])).error == "hardware_fault"
        assert rig.grip("open", 0.08).error == "hardware_fault"
    rig.run(6.0)
    with monkeypatch.context() as broken:
        broken.setattr(rig.hardware.gripper, "command", fail)
        assert "no answer" in rig.grip("again", 0.08).message
    rig.run(6.0)
    with monkeypatch.context() as broken:
        broken.setattr(rig.hardware.gripper, "command", fail_without_a_word)
        assert rig.grip("still", 0.08).message == "moving the gripper: HardwareFault"
    rig.run(6.0)
    assert rig.grip("now", 0.08).state == "active"
    assert rig.execute("c", rest_to_rest(rig.joints[-1].position[:2], [0.5, 0.5])).state == "active"


def test_nothing_moves_before_the_arm_was_read(limits, rest_to_rest):
    rig = Rig(limits, MockHardware(np.array([0.5, 0.0]), SimulatedFingers(GRIPPER, 0.08)))
    answer = rig.execute("a", rest_to_rest([0, 0], [0.2, 0.2]))
    assert answer.error == "hardware_fault" and "where the arm is" in answer.message
    rig.step()
    assert rig.execute("b", rest_to_rest([0.5, 0], [0.2, 0.2])).state == "active"


def test_real_hardware_has_no_world_to_edit(limits):
    cycle = ControlCycle(MockHardware(START, SimulatedFingers(GRIPPER, 0.08)), limits, START, gripper=GRIPPER)
    with pytest.raises(Refused, match="real hardware"):
        cycle.edit(WorldEdit(op="reset"), 1.0)
    cycle.command(GripperCommand(id="close", width=0.0), 1.0)
    for tick in range(200):
        report = cycle.step(Header(stamp=int(1e9 + tick * 1e7)))
        assert report.objects is None and not report.updates
    assert report.joints is not None and report.joints.position[2:] == [0, 0]


def test_arm_without_gripper_refuses_gripper_commands(limits):
    cycle = ControlCycle(MockHardware(START, None), limits, START)
    with pytest.raises(Refused, match="no gripper"):
        cycle.command(GripperCommand(id="close", width=0.0), 1.0)
    report = cycle.step(Header(stamp=1))
    assert report.gripper is None and report.joints is not None and len(report.joints.name) == 2


class Numb:
    """Fingers of a simulated arm that feel nothing."""

    def command(self, width, now, effort):
        pass

    def read(self, now):
        raise AssertionError


@pytest.mark.parametrize("fingers", [None, Numb()])
def test_backend_whose_gripper_does_not_fit_is_a_configuration_error(limits, fingers):
    with pytest.raises(ConfigError, match=r"robot\.hardware\.backend"):
        Rig(limits, MockHardware(START, fingers))


def test_fingers_that_nobody_told_anything_stay_where_they_are_after_a_restart(limits):
    rig = Rig(limits)
    rig.run(0.1)
    standing = rig.cycle.standing()
    assert standing.width == 0.08
    again = Rig(limits, MockHardware(START, SimulatedFingers(GRIPPER, 0.05)))
    again.cycle.restore(standing, again.now)
    again.run(1.0)
    assert {state.width for state in again.grippers} == {0.08}


def test_what_takes_long_in_the_world_is_left_to_others_and_the_arm_goes_on(rig, monkeypatch):
    rig.cycle.beside = True
    monkeypatch.setattr(KinematicWorld, "_is_plain", False)
    rig.grip("close", 0.0)
    while rig.cycle.due is None:
        rig.step()
    before = len(rig.joints)
    with monkeypatch.context() as patched:
        for name in ("tick", "obstruction", "objects", "take_events", "standing"):
            owner = next(made for made in KinematicWorld.__mro__ if name in vars(made))
            patched.delattr(owner, name)  # nothing of it is asked meanwhile
        rig.run(0.2)
        assert len(rig.joints) == before + 20 and rig.cycle.standing() is None
    rig.cycle.due()
    rig.cycle.due, rig.cycle.apart = None, False
    rig.step()
    assert rig.world.held == "ball_1" and rig.cycle.standing() is not None


def in_the_way(goal, hold=True):
    return HoldRequest(hold=hold, reason="mug is in the way of hand", by="scene_monitor", goal=goal)


def test_hold_for_a_goal_keeps_that_goal_and_ends_with_it(rig, rest_to_rest):
    trajectory = rest_to_rest([0, 0], [0.3, 0.3])
    assert rig.execute("a", trajectory).state == "active"
    rig.run(0.3)
    assert rig.cycle.authority.hold(in_the_way("a"))[0].held_by == ["scene_monitor"]
    rig.run(2.0)
    status = rig.motions[-1]
    assert status.state == "active" and not status.paused and "held: mug is in the way of hand" in status.message
    assert [(one.by, one.reason) for one in status.interlocks] == [("scene_monitor", "mug is in the way of hand")]
    rig.cycle.authority.stop(StopRequest(id="a", by="requester"), rig.now)
    rig.run(0.5)
    assert (rig.motions[-1].state, rig.motions[-1].held) == ("cancelled", False)
    assert rig.execute("b", trajectory).state == "rejected"  # the arm has moved on since
    assert not rig.cycle.authority.hold(in_the_way("a"))[0].held, "what was said of a goal that is over holds no other"


def test_the_scene_monitor_lets_go_of_nobody_elses_hold(rig, rest_to_rest):
    rig.execute("a", rest_to_rest([0, 0], [0.3, 0.3]))
    rig.cycle.authority.hold(HoldRequest(hold=True, owner="anna"))
    rig.cycle.authority.hold(in_the_way("a"))
    rig.cycle.authority.hold(in_the_way("a", hold=False))
    rig.run(1.0)
    assert rig.motions[-1].held_by == ["operator"] and rig.motions[-1].progress < 0.1
    rig.cycle.authority.hold(in_the_way("a"))
    rig.cycle.authority.hold(HoldRequest(hold=False, owner="anna"))
    rig.run(1.0)
    assert rig.motions[-1].held_by == ["scene_monitor"], "nor a person of the scene monitor's"


def test_goal_tells_of_its_plan_and_what_is_followed_can_be_asked_for(rig, rest_to_rest):
    request = ExecuteRequest(id="a", trajectory=rest_to_rest([0, 0], [0.3, 0.3]), plan="p", scene_stamp=7)
    rig.cycle.execute(request, rig.now)
    rig.step()
    assert (rig.motions[-1].plan, rig.motions[-1].scene_stamp) == ("p", 7)
    assert rig.cycle.followed("a") == request
    for goal in ("b", ""):
        with pytest.raises(Refused, match=f"goal '{goal}' is not followed now"):
            rig.cycle.followed(goal)
    rig.run(5.0)
    with pytest.raises(Refused):
        rig.cycle.followed("a")
