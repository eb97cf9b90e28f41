"""Obstructions of the running motion are reported, and nothing else is."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from common.config import load_cell
from common.messages import (
    AttachedObject,
    CollisionObject,
    Header,
    JointGoal,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanningScene,
    PlanRequest,
    Pose,
    PoseGoal,
    Quaternion,
    Vector3,
)
from common.planning.pipeline import PlanningPipeline
from common.planning.scene_monitor import MOVED, NotMonitored, SceneMonitor
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, tool_down

CELL = load_cell("panda")
ROBOT = RobotModel.load(CELL.robot)
HOME = ROBOT.named("home")
THERE = HOME + np.array([1.2, 0.3, 0, 0, 0, 0, 0])
HALF = HOME + 0.5 * (THERE - HOME)
FINGERS = CELL.robot.gripper.links


def item(name: str, at, shape: str = "sphere", dimensions=(0.03,), role: str = "target", turn: float = 0.0):
    x, y, z = (float(v) for v in at)
    return CollisionObject(
        id=name, role=role, shape=shape, dimensions=list(dimensions),
        pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(z=np.sin(turn / 2), w=np.cos(turn / 2))))


def up(place, by: float):
    return place + np.array([0.0, 0.0, by])


def scene(*objects: CollisionObject, **fields: object) -> PlanningScene:
    table = item("table", (0.5, 0, -0.025), "box", (1.0, 1.0, 0.05), "fixture")
    return PlanningScene(header=Header(stamp=7, frame_id="world"), objects=[table, *objects], **fields)


@pytest.fixture(scope="module")
def pipeline() -> PlanningPipeline:
    return PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)


@pytest.fixture
def monitor() -> SceneMonitor:
    return SceneMonitor(CELL.robot, CELL.motion.object_padding)


def start_motion(monitor, pipeline, on: PlanningScene, start=HOME, **fields: object) -> JointTrajectory:
    request = PlanRequest(id="p", **{"goal": JointGoal(positions=THERE.tolist()), **fields})
    response = pipeline.plan(request, on, start)
    assert response.ok and response.scene_stamp == 7, response.message
    monitor.add_plan(request, on, response.trajectory)
    monitor.follow("g", "p")
    return response.trajectory


def test_obstruction_is_reported_with_the_link_until_it_is_gone(monitor, pipeline):
    start_motion(monitor, pipeline, scene())
    assert monitor.find_obstruction(scene(), 0.0) == ""
    problem = monitor.find_obstruction(scene(item("mug", ROBOT.fk(HALF)[:3, 3])), 0.1)
    assert problem.startswith("mug obstructs panda_")
    assert monitor.find_obstruction(scene(), 0.1) == ""


def test_object_behind_the_arm_does_not_obstruct(monitor, pipeline):
    start_motion(monitor, pipeline, scene())
    mug = scene(item("mug", ROBOT.fk(HALF)[:3, 3]))
    assert monitor.find_obstruction(mug, 0.2)
    monitor.follow("g", "p")
    assert monitor.find_obstruction(mug, 0.9) == ""


def test_obstruction_between_two_states_is_found(monitor, pipeline):
    trajectory = start_motion(monitor, pipeline, scene())
    times = [point.time_from_start for point in trajectory.points]
    assert max(np.diff(times)) > 0.3, "states are far apart: checking them alone is not enough"
    for share in np.linspace(0.15, 0.95, 15):
        monitor.follow("g", "p")
        q = HOME + share * (THERE - HOME)
        wire = item("wire", ROBOT.fk(q)[:3, 3], "cylinder", (0.002, 0.3), "fixture")
        assert monitor.find_obstruction(scene(wire), 0.0).startswith("wire obstructs panda_"), share


def test_planned_object_may_move_slightly_under_any_id(monitor, pipeline):
    near = ROBOT.fk(HALF)[:3, 3]
    near[2] -= 0.034  # as near to the gripper as a plan may lead
    while not pipeline.plan(PlanRequest(id="p", goal=JointGoal(positions=THERE.tolist()), planner="joint_move"),
                            scene(item("ball_1", near)), HOME).ok:
        near[2] -= 0.001
    start_motion(monitor, pipeline, scene(item("ball_1", near)), planner="joint_move")
    shaken = up(near, 0.9 * MOVED)
    assert monitor.find_obstruction(scene(item("ball_9", shaken)), 0.0) == ""
    assert monitor.find_obstruction(scene(item("ball_9", up(near, 3 * MOVED))), 0.0)


def test_object_that_grows_is_new(monitor, pipeline):
    below = ROBOT.fk(HALF)[:3, 3] - (0.0, 0.0, 0.12)
    start_motion(monitor, pipeline, scene(item("box", below, "box", (0.02, 0.02, 0.02))))
    assert monitor.find_obstruction(scene(item("box", below, "box", (0.02, 0.02, 0.02), turn=1.0)), 0.0) == ""
    assert monitor.find_obstruction(scene(item("box", below, "box", (0.02, 0.02, 0.3))), 0.0)


def test_allowed_contact_does_not_obstruct(monitor, pipeline):
    over = tool_down(0.5, 0.1, 0.13)
    grasp = matrix_to_pose(tool_down(0.5, 0.1, 0.03))
    goal = PoseGoal(pose=matrix_to_pose(over))
    above = pipeline.plan(PlanRequest(id="o", goal=goal), scene(), HOME).trajectory.points[-1].positions
    ball = scene(item("ball_1", (0.5, 0.1, 0.03)))
    start_motion(monitor, pipeline, ball, np.array(above), goal=PoseGoal(pose=grasp), straight=True, release=True,
          allowed_collisions=[(link, "ball_1") for link in FINGERS])
    assert monitor.find_obstruction(scene(item("ball_1", (0.512, 0.105, 0.03))), 0.3) == "", "it is the grasped object"
    other = scene(item("ball_1", (0.5, 0.1, 0.03)), item("ball_2", (0.5, 0.15, 0.03)))
    assert monitor.find_obstruction(other, 0.3).startswith("ball_2 obstructs")


def test_attached_object_moves_with_the_arm_before_and_after_the_scene_shows_it(monitor, pipeline):
    at = ROBOT.fk(HOME)[:3, 3]
    lies = scene(item("ball_1", at))
    start_motion(monitor, pipeline, lies, attach="ball_1", attach_pose=Pose())
    held = AttachedObject(link=CELL.robot.tcp_link, object=item("ball_1", (0.002, 0, 0), role="attached"))
    carried = scene(attached=[held], allowed_collisions=[(link, "ball_1") for link in FINGERS])
    for seen in (lies, scene(item("ball_1", at + np.array([0.01, 0, 0]))), scene(), carried):
        assert monitor.find_obstruction(seen, 0.05) == ""
    rod = item("rod", ROBOT.fk(HALF)[:3, 3] - (0, 0, 0.028), "cylinder", (0.001, 0.001), "fixture")
    assert "ball_1" in monitor.find_obstruction(scene(rod, attached=[held]), 0.05)


def test_motion_planned_elsewhere_is_checked_against_the_complete_scene(monitor, pipeline):
    trajectory = start_motion(monitor, pipeline, scene())
    other = SceneMonitor(CELL.robot, 0.003)
    turned = trajectory.model_copy(update={"joint_names": trajectory.joint_names[::-1], "points": [
        p.model_copy(update={n: getattr(p, n)[::-1] for n in ("positions", "velocities", "accelerations")})
        for p in trajectory.points]})
    place = ROBOT.fk(HALF)[:3, 3] + np.array([0, 0, 0.01])
    for each in (trajectory, turned):
        other.follow("g", "unknown", each)
        assert other.find_obstruction(scene(), 0.0) == ""
        assert other.find_obstruction(scene(item("ball", place, dimensions=(0.004,))), 0.0) == ""
        post = item("post", place, "box", (0.01, 0.01, 0.01), "fixture")
        assert other.find_obstruction(scene(post), 0.0).startswith("post obstructs")
    with pytest.raises(NotMonitored, match="goal 'h' moves other joints"):
        other.follow("h", "", trajectory.model_copy(update={"joint_names": list("abcdefg")}))
    assert other.find_obstruction(scene(post), 0.0) == "", "the trajectory before is discarded"


def test_trajectory_without_points_is_not_monitored(monitor):
    with pytest.raises(NotMonitored, match="goal 'g' has no points"):
        monitor.follow("g", "", JointTrajectory(joint_names=ROBOT.joint_names, points=[]))


@pytest.mark.parametrize("seconds, far", [(1.0, 1e12), (1e6, 1.0)])
def test_trajectory_with_too_many_states_is_not_monitored(monitor, seconds, far):
    none = [0.0] * ROBOT.dof
    fast = [1e12] * ROBOT.dof
    points = [JointTrajectoryPoint(time_from_start=0.0, positions=HOME.tolist(), velocities=none, accelerations=none),
              JointTrajectoryPoint(time_from_start=seconds, positions=[far] * ROBOT.dof, velocities=fast,
                                   accelerations=none)]
    monitor.follow("g", "", JointTrajectory(joint_names=ROBOT.joint_names, points=points))
    with pytest.raises(NotMonitored, match="more than 25000 states"):
        monitor.find_obstruction(scene(item("ball", (0.5, 0.0, 0.5))), 0.0)


def test_unchanged_scene_is_checked_once(monitor, pipeline):
    start_motion(monitor, pipeline, scene())
    mug = scene(item("mug", ROBOT.fk(HALF)[:3, 3]))
    problem = monitor.find_obstruction(mug, 0.0)
    with patch.object(monitor, "_hit", side_effect=AssertionError):
        again = mug.model_copy(update={"header": Header(stamp=9, frame_id="world")})
        assert monitor.find_obstruction(again, 0.1) == problem


def test_obstruction_has_to_leave_by_a_clear_distance(monitor, pipeline):
    start_motion(monitor, pipeline, scene())
    place = ROBOT.fk(HALF)[:3, 3]
    away = next(d for d in np.arange(0.0, 0.2, 0.001) if _free(monitor, up(place, -d)))
    assert monitor.find_obstruction(scene(item("mug", place)), 0.0)
    assert monitor.find_obstruction(scene(item("mug", up(place, -away))), 0.0), "a tiny distance is not enough"
    assert monitor.find_obstruction(scene(item("mug", up(place, -away - 0.007))), 0.0) == ""


def _free(monitor: SceneMonitor, place) -> bool:
    monitor.follow("g", "p")
    return monitor.find_obstruction(scene(item("mug", place)), 0.0) == ""


def test_clear_distance_applies_only_to_the_obstruction(monitor, pipeline):
    start_motion(monitor, pipeline, scene())
    place = ROBOT.fk(HALF)[:3, 3]
    away = next(d for d in np.arange(0.0, 0.2, 0.001) if _free(monitor, up(place, -d)))
    close_by = item("bowl", up(place, -away))  # never obstructing, but within the clear distance
    monitor.follow("g", "p")
    assert monitor.find_obstruction(scene(close_by), 0.0) == ""
    assert monitor.find_obstruction(scene(close_by, item("mug", place)), 0.0).startswith("mug ")
    assert monitor.find_obstruction(scene(close_by), 0.0) == ""
