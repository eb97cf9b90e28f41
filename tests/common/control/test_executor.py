"""The executor's cycle: gripper and world, goals and their holds, restarts of simulated hardware."""

import numpy as np
import pytest

from common import messages as m
from common.config import World
from common.control.executor import Executor
from common.errors import ConfigError, Refused
from common.hardware.mock import MockHardware, SimulatedFingers
from common.sim.interface import ObjectSnapshot
from common.sim.kinematic import KinematicWorld
from tests.common.control.rig import GRIPPER, START, TABLE, ExecutorRig, mock


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



def test_executor_works_without_a_world_and_without_a_gripper(limits):
    close = m.GripperCommand(id="close", width=0.0)
    executor = Executor(MockHardware(START, None), limits, START)
    with pytest.raises(Refused, match="no gripper"):
        executor.command_gripper(close, 1.0)
    report = executor.cycle(m.Header(stamp=1))
    assert report.gripper is None and report.joints is not None and len(report.joints.name) == 2
    executor = Executor(mock(), limits, START, gripper=GRIPPER)
    executor.restore(1.0)
    executor.command_gripper(close, 1.0)
    for tick in range(100):
        report = executor.cycle(m.Header(stamp=int(1e9 + tick * 1e7)))
        assert report.objects is None and not report.updates
    assert report.joints is not None and report.joints.position[2:] == [0, 0]



@pytest.mark.parametrize("fingers", [None, "fingers that objects cannot block"])
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
            return m.WorldObjects(header=header)

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
    again.cell.edit(m.WorldEdit(op="drop", id="ball_1"), again.now)
    again.run(1.0)
    assert again.grippers[-1].outcome == "slipping"


@pytest.mark.parametrize("held", [False, True])
def test_stopped_fingers_stay_where_they_were_before_a_restart_and_press_as_before(limits, rig, held):
    rig.grip("close", 0.0, effort=40.0)
    rig.run(1.0 if held else 0.05)
    width = rig.grippers[-1].width
    again = rig.restarted(limits, m.StopRequest(owner="anna"))
    again.run(1.0)
    found = again.grippers[-1]
    assert found.holding == held and found.width == pytest.approx(width, abs=2e-3)
    assert not held or found.effort == 40.0


def test_fingers_without_a_command_stay_where_they_were_before_a_restart(limits, rig):
    assert rig.saved.width == 0.08
    again = rig.restarted(limits, hardware=mock(width=0.05))
    again.run(1.0)
    assert {state.width for state in again.grippers} == {0.08}


# --- goals ---



def test_nothing_moves_before_the_first_joint_reading(limits, rest_to_rest):
    rig = ExecutorRig(limits, mock(np.array([0.5, 0.0])))
    answer = rig.execute("a", rest_to_rest([0, 0], [0.2, 0.2]))
    assert (answer.error, answer.message) == ("hardware_fault", "no joint reading received yet")
    rig.step()
    assert rig.execute("b", rest_to_rest([0.5, 0], [0.2, 0.2])).state == "active"


def obstructed(hold=True):
    return m.HoldRequest(hold=hold, reason="mug obstructs hand", by="scene_monitor", goal="a")


def test_hold_for_a_goal_holds_only_that_goal_and_ends_with_it(rig, rest_to_rest):
    trajectory, authority = rest_to_rest([0, 0], [0.3, 0.3]), rig.executor.authority
    assert rig.execute("a", trajectory).state == "active"
    rig.run(0.3)
    assert authority.hold(obstructed())[0].held_by == ["scene_monitor"]
    rig.run(2.0)
    status = rig.motions[-1]
    assert status.state == "active" and not status.paused and "held: mug obstructs hand" in status.message
    assert [(one.by, one.reason) for one in status.interlocks] == [("scene_monitor", "mug obstructs hand")]
    authority.hold(m.HoldRequest(hold=True, owner="anna"))
    assert authority.hold(obstructed(hold=False))[0].held_by == ["operator"], "each releases only its own hold"
    both = authority.hold(obstructed())[0]
    assert both.held_by == ["operator", "scene_monitor"] and "mug obstructs hand" in both.message and both.paused
    assert authority.hold(m.HoldRequest(hold=False, owner="anna"))[0].held_by == ["scene_monitor"]
    authority.stop(m.StopRequest(id="a", by="requester"), rig.now)
    rig.run(0.5)
    assert (rig.motions[-1].state, rig.motions[-1].held) == ("cancelled", False)
    assert rig.execute("b", trajectory).state == "rejected", "the arm is not at its start any more"
    assert not authority.hold(obstructed())[0].held, "that goal is over"



def test_goal_reports_its_plan_and_its_request_can_be_read_while_it_is_followed(rig, rest_to_rest):
    request = m.ExecuteRequest(id="a", trajectory=rest_to_rest([0, 0], [0.3, 0.3]), plan="p", scene_stamp=7)
    rig.executor.execute(request, rig.now)
    rig.step()
    assert (rig.motions[-1].plan, rig.motions[-1].scene_stamp) == ("p", 7)
    assert rig.executor.followed("a") == request
    for goal in ("b", ""):
        with pytest.raises(Refused, match=f"goal '{goal}' is not followed now"):
            rig.executor.followed(goal)
    rig.run(2.0)
    assert rig.motions[-1].state == "succeeded" and 9 <= len(rig.motions) <= 16, "progress is reported each 0.1 s"
    with pytest.raises(Refused):
        rig.executor.followed("a")
