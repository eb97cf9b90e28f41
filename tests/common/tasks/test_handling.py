"""What every task does that brings objects somewhere, with one that brings all of them to one place."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from common import messages as m
from common.config import Surroundings, load_cell
from common.robot.model import RobotModel
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix, rpy_to_matrix, transform
from common.tasks.handling import Handling, HandlingConfig, HandlingStatus
from common.tasks.stages import Cycle, Grip, Move, View

CELL = load_cell("panda")
HOME, AWAY = list(CELL.robot.named_poses["home"]), [0.1] * 7
TCP = matrix_to_pose(RobotModel.load(CELL.robot).fk(np.array(HOME)))


class Gather(Handling):
    """Bring all targets to one place."""

    def choose(self, view: View) -> None:
        things = view.objects("target")
        if things:
            self.bring(things, view)
        else:
            self.finish(view, seen=0.0)

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose:
        return m.Pose(position=m.Vector3(x=0.4, y=0.2, z=0.02))


def task(**parameters: object) -> Gather:
    sections = {"robot": CELL.robot, "run": CELL.run, "grasp": CELL.grasp, "world": CELL.section(Surroundings)}
    return Gather(HandlingConfig.model_validate(sections | parameters), HandlingStatus(), "t")


def box(name: str, x: float, y: float, yaw: float = 0.0, size: tuple[float, float, float] = (0.04, 0.04, 0.04),
        z: float = 0.02) -> m.CollisionObject:
    pose = matrix_to_pose(transform(rpy_to_matrix(0.0, 0.0, yaw), (x, y, z)))
    return m.CollisionObject(id=name, role="target", shape="box", dimensions=list(size), pose=pose, kind="cube")


def view(*objects: m.CollisionObject, now: float = 10.0, q: list[float] = HOME,
         held: m.CollisionObject | None = None, stamp: float | None = None) -> View:
    attached = [m.AttachedObject(link="panda_hand_tcp", object=held)] if held else []
    seen = now if stamp is None else stamp
    scene = m.PlanningScene(header=m.Header(stamp=int(seen * 1e9)), objects=list(objects), attached=attached)
    gripper = m.GripperState(width=0.04 if held else 0.08, holding=held is not None)
    return View(now, scene, gripper, m.MotionStatus(), q, TCP)


class Decided:
    """Stages that a task puts in its queue."""

    def __init__(self, seen: View, of: Gather | None = None) -> None:
        of = of or task()
        of.decide(seen)
        self.stages: list[Any] = list(of.queue)
        self.names = [stage.name for stage in self.stages]

    def move(self, name: str) -> Move:
        return next(stage for stage in self.stages if isinstance(stage, Move) and stage.name == name)

    def pose(self, name: str) -> np.ndarray:
        """Goal of a motion (4, 4)."""
        goal = self.move(name).goal
        assert isinstance(goal, m.PoseGoal)
        return pose_to_matrix(goal.pose)


@pytest.mark.parametrize("yaw", [0.0, 0.5, -0.7, 1.4, 3.0])
def test_fingers_close_on_two_faces_of_a_cube_at_any_yaw_and_bring_it_to_its_destination(yaw: float) -> None:
    thing = box("a", 0.5, -0.1, yaw)
    decided = Decided(view(thing))
    T_cube_tool = invert(pose_to_matrix(thing.pose)) @ decided.pose("descend")
    assert sorted(np.abs(T_cube_tool[:3, 1]).round(6)) == [0.0, 0.0, 1.0]  # the fingers close along y of the tool
    np.testing.assert_allclose(T_cube_tool[:3, 3], 0.0, atol=1e-9)
    T_world_cube = decided.pose("lower") @ invert(T_cube_tool)
    np.testing.assert_allclose(T_world_cube[:3, 3], (0.4, 0.2, 0.02), atol=0.005)
    assert abs(math.remainder(math.atan2(T_world_cube[1, 0], T_world_cube[0, 0]), math.pi / 2)) < 1e-6
    carried = decided.move("across")
    assert carried.attach == "a" and carried.attach_pose == decided.move("lift").attach_pose


def test_a_long_box_is_gripped_across_and_its_width_is_expected() -> None:
    stages = Decided(view(box("a", 0.5, 0.0, 0.4, size=(0.12, 0.03, 0.04)))).stages
    assert [stage.expected_width for stage in stages if isinstance(stage, Grip) and stage.name == "close"] == [0.03]


def test_cup_takes_the_top_face_of_a_box_wider_than_any_gripper() -> None:
    robot = load_cell("panda", ["robot=ur5_cup"]).robot
    wide = box("a", 0.5, 0.0, 0.4, (0.2, 0.15, 0.06), z=0.03)
    decided = Decided(view(wide, q=list(robot.named_poses["home"])), task(robot=robot))
    assert math.isclose(decided.pose("descend")[2, 3], 0.06) and decided.pose("descend")[2, 2] < -0.999
    grips = [stage for stage in decided.stages if isinstance(stage, Grip)]
    assert [(stage.width, stage.expected_width) for stage in grips] == [(0.08, None), (0.0, 0.04), (0.08, None)]
    assert decided.move("descend").touches == [("cup_link", "a")]


def test_nothing_is_chosen_before_the_objects_of_the_newest_image_are_confirmed() -> None:
    of, seen = task(), view(box("a", 0.5, 0.0))
    assert seen.scene is not None
    of.images_after = 9.0
    seen.scene.settled = 8_900_000_000
    assert Decided(seen, of).stages == [] and not of.shown(seen)
    seen.scene.settled = 9_500_000_000
    assert Decided(seen, of).stages and of.shown(seen)


@pytest.mark.parametrize(("clearance", "width"), [(0.02, 0.06), (0.5, 0.08)])
def test_fingers_open_as_wide_as_the_task_says(clearance: float, width: float) -> None:
    for stages in (Decided(view(box("a", 0.5, 0.0)), task(finger_clearance=clearance)).stages,
                   Decided(view(held=box("a", 0.0, 0.0, z=0.0)), task(finger_clearance=clearance)).stages):
        opened = [one.width for one in stages if isinstance(one, Grip) and one.name != "close"]
        assert opened == pytest.approx([width] * len(opened)) and opened


def test_only_the_support_may_be_touched() -> None:
    of = task()
    of.queue.extend(of.put(box("a", 0.5, 0.0), m.Pose(), Cycle("a"), view(
        box("below", 0.4, 0.2, z=-0.02), box("near", 0.4, 0.23)), None))
    assert next(stage for stage in of.queue if stage.name == "lower").touches == [("a", "below")]


def test_held_object_continues_to_its_destination_or_home_without_a_scene() -> None:
    held = box("a", 0.0, 0.0, z=0.0)
    decided = Decided(view(held=held, q=AWAY))
    assert decided.names[:3] == ["across", "lower", "release"]
    assert decided.move("across").attach_pose is None, "it is in the scene already"
    unseen = Decided(view(held=held, q=AWAY, stamp=0.0))
    assert unseen.move("home").carries and len(unseen.stages) == 2
    assert Decided(view(held=held, stamp=0.0)).stages == [], "there it waits for the picture"


def test_unknown_object_is_put_aside_in_free_space() -> None:
    held = m.CollisionObject(id="x", role="attached", shape="sphere", dimensions=[0.03], pose=m.Pose())
    others = [box(str(k), 0.5, -0.2 + 0.1 * k) for k in range(5)]
    place = Decided(view(*others, held=held)).pose("lower")[:2, 3]
    assert all(math.dist(place, (thing.pose.position.x, thing.pose.position.y)) > 0.08 for thing in others)
    container = CELL.world.container
    assert math.dist(place, (container.x, container.y)) > container.half_side


def test_empty_gripper_away_from_home_goes_home_first() -> None:
    assert Decided(view(box("a", 0.5, 0.0), q=AWAY)).names == ["retreat", "home", "look"]


def test_failed_object_comes_last_with_other_faces_until_given_up() -> None:
    of, turns = task(most_tries=2), []
    a, b = box("a", 0.5, 0.0), box("b", 0.5, 0.2)
    no = m.PlanResponse(id="1", ok=False, error="no_plan", message="no way")
    for now, wanted in ((10.0, "a"), (11.0, "b"), (12.0, "a"), (13.0, "b")):
        of.clear()
        decided = Decided(view(a, b, now=now), of)
        descend = decided.move("descend")
        assert descend.cycle is not None and descend.cycle.subject == wanted
        turns.append(decided.pose("descend")[:3, 1].round(6).tolist())
        of.plan_failed(descend, no, view(a, b, now=now))
    assert abs(np.dot(turns[0], turns[2])) < 1e-6, "a quarter turn from the first"
    of.clear()
    of.decide(view(a, b, now=14.0))
    assert (of.status.state, of.status.message) == ("ERROR", "cube at (0.500, 0.000): no way")


def test_what_is_missing_ends_the_task_with_that_reason_after_a_while_and_moves_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Gather, "choose", lambda self, seen: self.lack("no part is seen", seen))
    of = task(give_up=5.0)
    for now, state in ((10.0, "IDLE"), (14.9, "IDLE"), (15.1, "ERROR")):
        of.decide(view(now=now))
        assert (of.status.state, of.status.message, len(of.queue)) == (state, "no part is seen", 0)


def test_task_is_done_after_the_settling_time_and_stays_so() -> None:
    of = task(settle=1.0)
    for now in (10.0, 10.5, 10.9):
        of.decide(view(now=now))
        assert of.status.state == "IDLE"
    of.decide(view(now=11.1))
    assert (of.status.state, of.status.figures) == ("DONE", {"seen": 0.0})
    assert Decided(view(box("a", 0.5, 0.0), now=20.0), of).stages == []


@pytest.mark.parametrize("far", [
    box("far", 1e7, 0.0), box("far", 0.5, 0.0, z=1e7), box("far", 0.5, 0.0, size=(1e9, 1e9, 1e9))])
def test_objects_out_of_range_are_ignored(far: m.CollisionObject) -> None:
    assert Decided(view(far, box("a", 0.5, -0.1))).move("descend").touches[0][1] == "a"
    assert Decided(view(far)).stages == []
    assert Decided(view(held=far)).stages == [], "it waits for a scene with the object in the hand"
