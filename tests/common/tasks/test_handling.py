"""What every task does that brings objects somewhere, with one that puts all of them at one place."""

from __future__ import annotations

import math

import numpy as np
import pytest

from common import messages as m
from common.config import Surroundings, load_cell
from common.robot.model import RobotModel
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix, rpy_to_matrix, transform
from common.tasks.handling import Handling, HandlingConfig, HandlingStatus
from common.tasks.stages import Cycle, Grip, Move, View

CELL = load_cell("panda")
HOME = list(CELL.robot.named_poses["home"])
TCP = matrix_to_pose(RobotModel.load(CELL.robot).fk(np.array(HOME)))
THERE = m.Pose(position=m.Vector3(x=0.4, y=0.2, z=0.02))


class Gather(Handling):
    """Everything is to come to one place."""

    def choose(self, view: View) -> None:
        things = view.objects("target")
        if things:
            self.bring(things, view)
        else:
            self.finish(view, seen=0.0)

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose:
        return THERE


def task(**parameters: object) -> Gather:
    around = CELL.section(Surroundings)
    return Gather(HandlingConfig.model_validate({
        "robot": CELL.robot, "run": CELL.run, "grasp": CELL.grasp, "world": around, **parameters,
    }), HandlingStatus(), "t")


def box(name: str, x: float, y: float, yaw: float = 0.0, size: tuple[float, float, float] = (0.04, 0.04, 0.04),
        z: float = 0.02) -> m.CollisionObject:
    pose = matrix_to_pose(transform(rpy_to_matrix(0.0, 0.0, yaw), (x, y, z)))
    return m.CollisionObject(id=name, role="target", shape="box", dimensions=list(size), pose=pose, kind="cube")


def view(*objects: m.CollisionObject, now: float = 10.0, q: list[float] | None = None, holding: bool = False,
         held: m.CollisionObject | None = None, stamp: float | None = None) -> View:
    attached = [m.AttachedObject(link="panda_hand_tcp", object=held)] if held else []
    seen = now if stamp is None else stamp
    scene = m.PlanningScene(header=m.Header(stamp=int(seen * 1e9)), objects=list(objects), attached=attached)
    gripper = m.GripperState(width=0.04 if holding else 0.08, holding=holding)
    return View(now, scene, gripper, m.MotionStatus(), q or HOME, TCP)


def row(of: Gather, seen: View) -> list[object]:
    of.decide(seen)
    return list(of.queue)


def move(stages: list[object], name: str) -> Move:
    return next(stage for stage in stages if isinstance(stage, Move) and stage.name == name)


def matrix(of: Move) -> np.ndarray:
    assert isinstance(of.goal, m.PoseGoal)
    return pose_to_matrix(of.goal.pose)


@pytest.mark.parametrize("yaw", [0.0, 0.5, -0.7, 1.4, 3.0])
def test_fingers_close_on_two_faces_of_a_cube_at_any_yaw(yaw: float) -> None:
    stages = row(task(), view(box("a", 0.5, -0.1, yaw)))
    T_cube_tool = invert(pose_to_matrix(box("a", 0.5, -0.1, yaw).pose)) @ matrix(move(stages, "descend"))
    across = np.abs(T_cube_tool[:3, 1])  # the fingers close along y of the tool
    assert sorted(across.round(6)) == [0.0, 0.0, 1.0]
    np.testing.assert_allclose(T_cube_tool[:3, 3], 0.0, atol=1e-9)


def test_a_long_box_is_gripped_across_and_its_width_is_expected() -> None:
    stages = row(task(), view(box("a", 0.5, 0.0, 0.4, size=(0.12, 0.03, 0.04))))
    close = next(stage for stage in stages if isinstance(stage, Grip) and stage.name == "close")
    assert close.expected_width == 0.03


def test_cube_ends_at_its_destination_from_any_grip() -> None:
    thing = box("a", 0.5, -0.1, 0.5)
    stages = row(task(), view(thing))
    T_tool_cube = invert(matrix(move(stages, "descend"))) @ pose_to_matrix(thing.pose)
    T_world_cube = matrix(move(stages, "lower")) @ T_tool_cube
    np.testing.assert_allclose(T_world_cube[:3, 3], (0.4, 0.2, 0.02), atol=0.005)
    assert abs(math.remainder(math.atan2(T_world_cube[1, 0], T_world_cube[0, 0]), math.pi / 2)) < 1e-6
    carried = move(stages, "across")
    assert carried.attach == "a" and carried.attach_pose == move(stages, "lift").attach_pose


def test_only_the_support_may_be_touched() -> None:
    below, near = box("below", 0.4, 0.2, z=-0.02), box("near", 0.4, 0.23)
    of = task()
    of.queue.extend(of._put(box("a", 0.5, 0.0), m.Pose(), Cycle("a"), view(below, near)))
    assert move(list(of.queue), "lower").touches == [("a", "below")]


def test_held_object_is_carried_on() -> None:
    held = box("a", 0.0, 0.0, z=0.0)
    stages = row(task(), view(holding=True, held=held, q=[0.1] * 7))
    assert [stage.name for stage in stages][:3] == ["across", "lower", "release"]  # type: ignore[attr-defined]
    assert move(stages, "across").attach_pose is None, "it is in the scene already"


def test_held_object_without_a_scene_is_carried_home_first() -> None:
    held = box("a", 0.0, 0.0, z=0.0)
    stages = row(task(), view(holding=True, held=held, q=[0.1] * 7, stamp=0.0))
    assert move(stages, "home").carries and len(stages) == 2
    assert row(task(), view(holding=True, held=held, stamp=0.0)) == [], "there it waits for the picture"


def test_unknown_object_is_put_aside_in_free_space() -> None:
    held = m.CollisionObject(id="x", role="attached", shape="sphere", dimensions=[0.03], pose=m.Pose())
    standing = [box(str(k), 0.5, -0.2 + 0.1 * k) for k in range(5)]
    place = matrix(move(row(task(), view(*standing, holding=True, held=held)), "lower"))[:2, 3]
    assert all(math.dist(place, (thing.pose.position.x, thing.pose.position.y)) > 0.08 for thing in standing)
    container = CELL.world.container
    assert math.dist(place, (container.x, container.y)) > container.half_side


def test_empty_gripper_away_from_home_goes_home_first() -> None:
    stages = row(task(), view(box("a", 0.5, 0.0), q=[0.1] * 7))
    assert [stage.name for stage in stages] == ["retreat", "home", "look"]  # type: ignore[attr-defined]


def test_failed_object_comes_last_with_other_faces_until_given_up() -> None:
    of = task(most_tries=2)
    a, b = box("a", 0.5, 0.0), box("b", 0.5, 0.2)
    no = m.PlanResponse(id="1", ok=False, error="no_plan", message="no way")
    turns = []
    for now, wanted in ((10.0, "a"), (11.0, "b"), (12.0, "a"), (13.0, "b")):
        of.clear()
        descend = move(row(of, view(a, b, now=now)), "descend")
        assert descend.cycle is not None and descend.cycle.subject == wanted
        turns.append(matrix(descend)[:3, 1].round(6).tolist())
        of.plan_failed(descend, no, view(a, b, now=now))
    assert abs(np.dot(turns[0], turns[2])) < 1e-6, "a quarter turn from the first"
    of.clear()
    of.decide(view(a, b, now=14.0))
    assert (of.status.state, of.status.message) == ("ERROR", "cube at (0.500, 0.000): no way")


def test_task_is_done_after_the_settling_time_and_stays_so() -> None:
    of = task(settle=1.0)
    for now in (10.0, 10.5, 10.9):
        of.decide(view(now=now))
        assert of.status.state == "IDLE"
    of.decide(view(now=11.1))
    assert (of.status.state, of.status.figures) == ("DONE", {"seen": 0.0})
    assert row(of, view(box("a", 0.5, 0.0), now=20.0)) == []


@pytest.mark.parametrize("far", [
    box("far", 1e7, 0.0), box("far", 0.5, 0.0, z=1e7), box("far", 0.5, 0.0, size=(1e9, 1e9, 1e9))])
def test_objects_out_of_range_are_ignored(far: m.CollisionObject) -> None:
    stages = row(task(), view(far, box("a", 0.5, -0.1)))
    assert move(stages, "descend").touches[0][1] == "a"
    assert row(task(), view(far)) == []
    held = task()
    assert row(held, view(holding=True, held=far)) == [], "it waits for a scene that says what is in the hand"
