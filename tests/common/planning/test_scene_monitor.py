"""Obstructions of the running motion are reported, and nothing else is."""

import numpy as np
import pytest

from common.messages import AttachedObject, CollisionObject, Header, JointGoal, PlanningScene, Pose, Quaternion
from common.messages.robot import JointTrajectory, JointTrajectoryPoint
from common.planning.scene_monitor import MOVED, NotMonitored, SceneMonitor
from tests.common.planning.checks import PIPELINE, last
from tests.common.planning.requests import down, to
from tests.common.planning.scenes import CELL, HOME, ROBOT, solid

THERE = HOME + np.array([1.2, 0.3, 0, 0, 0, 0, 0])
HALF = HOME + 0.5 * (THERE - HOME)
AT_HALF = ROBOT.fk(HALF)[:3, 3]
FINGERS = CELL.robot.gripper.links
GOAL = JointGoal(positions=THERE.tolist())


def item(name: str, at, shape="sphere", dimensions=(0.03,), role="target", turn=0.0) -> CollisionObject:
    thing = solid(name, role, shape, list(dimensions), map(float, at))
    thing.pose.orientation = Quaternion(z=np.sin(turn / 2), w=np.cos(turn / 2))
    return thing


def up(place, by: float):
    return place + np.array([0.0, 0.0, by])


def scene(*objects: CollisionObject, **fields: object) -> PlanningScene:
    table = item("table", (0.5, 0, -0.025), "box", (1.0, 1.0, 0.05), "fixture")
    return PlanningScene(header=Header(stamp=7, frame_id="world"), objects=[table, *objects], **fields)


MUG = scene(item("mug", AT_HALF))


@pytest.fixture
def monitor() -> SceneMonitor:
    return SceneMonitor(CELL.robot, CELL.motion.object_padding)


def start_motion(monitor, on: PlanningScene, start=HOME, goal=GOAL, **fields: object) -> JointTrajectory:
    request = to(goal, start, **fields)
    response = PIPELINE.plan(request, on)
    assert response.ok and response.scene_stamp == 7, response.message
    monitor.add_plan(request, on, response.trajectory)
    monitor.follow("g", "1")
    return response.trajectory


def test_obstruction_is_reported_with_the_link_until_it_is_gone_or_behind_the_arm(monitor):
    start_motion(monitor, scene())
    assert monitor.find_obstruction(scene(), 0.0) == ""
    assert monitor.find_obstruction(MUG, 0.1).startswith("mug obstructs panda_")
    assert monitor.find_obstruction(scene(), 0.1) == "" and monitor.find_obstruction(MUG, 0.2)
    monitor.follow("g", "1")
    assert monitor.find_obstruction(MUG, 0.9) == ""


def test_obstruction_between_two_states_is_found(monitor):
    trajectory = start_motion(monitor, scene())
    times = [point.time_from_start for point in trajectory.points]
    assert max(np.diff(times)) > 0.3, "states are far apart: checking them alone is not enough"
    for share in np.linspace(0.15, 0.95, 8):
        monitor.follow("g", "1")
        q = HOME + share * (THERE - HOME)
        wire = item("wire", ROBOT.fk(q)[:3, 3], "cylinder", (0.002, 0.3), "fixture")
        assert monitor.find_obstruction(scene(wire), 0.0).startswith("wire obstructs panda_"), share


def test_planned_object_may_move_slightly_under_any_id(monitor):
    near = up(AT_HALF, -0.034)  # as near to the gripper as a plan may lead
    while not PIPELINE.plan(to(GOAL, planner="joint_move"), scene(item("ball_1", near))).ok:
        near = up(near, -0.001)
    start_motion(monitor, scene(item("ball_1", near)), planner="joint_move")
    assert monitor.find_obstruction(scene(item("ball_9", up(near, 0.9 * MOVED))), 0.0) == ""
    assert monitor.find_obstruction(scene(item("ball_9", up(near, 3 * MOVED))), 0.0)


def test_object_that_grows_is_new(monitor):
    below = up(AT_HALF, -0.12)
    start_motion(monitor, scene(item("box", below, "box", (0.02, 0.02, 0.02))))
    assert monitor.find_obstruction(scene(item("box", below, "box", (0.02, 0.02, 0.02), turn=1.0)), 0.0) == ""
    assert monitor.find_obstruction(scene(item("box", below, "box", (0.02, 0.02, 0.3))), 0.0)


def test_allowed_contact_does_not_obstruct(monitor):
    above = last(PIPELINE.plan(to(down(0.5, 0.1, 0.13)), scene()))
    ball = item("ball_1", (0.5, 0.1, 0.03))
    start_motion(monitor, scene(ball), above, down(0.5, 0.1, 0.03), straight=True, release=True,
                 allowed_collisions=[(link, "ball_1") for link in FINGERS])
    assert monitor.find_obstruction(scene(item("ball_1", (0.512, 0.105, 0.03))), 0.3) == "", "it is the grasped object"
    assert monitor.find_obstruction(scene(ball, item("ball_2", (0.5, 0.15, 0.03))), 0.3).startswith("ball_2 obstructs")


def test_attached_object_moves_with_the_arm_before_and_after_the_scene_shows_it(monitor):
    at = ROBOT.fk(HOME)[:3, 3]
    lies = scene(item("ball_1", at))
    start_motion(monitor, lies, attach="ball_1", attach_pose=Pose())
    held = AttachedObject(link=CELL.robot.tcp_link, object=item("ball_1", (0.002, 0, 0), role="attached"))
    carried = scene(attached=[held], allowed_collisions=[(link, "ball_1") for link in FINGERS])
    for seen in (lies, scene(item("ball_1", at + np.array([0.01, 0, 0]))), scene(), carried):
        assert monitor.find_obstruction(seen, 0.05) == ""
    rod = item("rod", up(AT_HALF, -0.028), "cylinder", (0.001, 0.001), "fixture")
    assert "ball_1" in monitor.find_obstruction(scene(rod, attached=[held]), 0.05)


def test_motion_planned_elsewhere_is_checked_against_the_complete_scene(monitor):
    trajectory = start_motion(monitor, scene())
    other = SceneMonitor(CELL.robot, 0.003)
    turned = trajectory.model_copy(update={"joint_names": trajectory.joint_names[::-1], "points": [
        p.model_copy(update={n: getattr(p, n)[::-1] for n in ("positions", "velocities", "accelerations")})
        for p in trajectory.points]})
    place = up(AT_HALF, 0.01)
    post = scene(item("post", place, "box", (0.01, 0.01, 0.01), "fixture"))
    for each in (trajectory, turned):
        other.follow("g", "unknown", each)
        assert other.find_obstruction(scene(), 0.0) == ""
        assert other.find_obstruction(scene(item("ball", place, dimensions=(0.004,))), 0.0) == ""
        assert other.find_obstruction(post, 0.0).startswith("post obstructs")
    with pytest.raises(NotMonitored, match="goal 'h' moves other joints"):
        other.follow("h", "", trajectory.model_copy(update={"joint_names": list("abcdefg")}))
    assert other.find_obstruction(post, 0.0) == "", "the trajectory before is discarded"


@pytest.mark.parametrize(("seconds", "far"), [(1.0, 1e12), (1e6, 1.0)])
def test_trajectory_without_points_or_with_too_many_states_is_not_monitored(monitor, seconds, far):
    with pytest.raises(NotMonitored, match="goal 'g' has no points"):
        monitor.follow("g", "", JointTrajectory(joint_names=ROBOT.joint_names, points=[]))
    none, fast = [0.0] * ROBOT.dof, [1e12] * ROBOT.dof
    points = [JointTrajectoryPoint(time_from_start=0.0, positions=HOME.tolist(), velocities=none, accelerations=none),
              JointTrajectoryPoint(time_from_start=seconds, positions=[far] * ROBOT.dof, velocities=fast,
                                   accelerations=none)]
    monitor.follow("g", "", JointTrajectory(joint_names=ROBOT.joint_names, points=points))
    with pytest.raises(NotMonitored, match="more than 25000 states"):
        monitor.find_obstruction(scene(item("ball", (0.5, 0.0, 0.5))), 0.0)


def test_obstruction_has_to_leave_by_a_clear_distance_and_other_objects_do_not(monitor):
    start_motion(monitor, scene())

    def obstruction(*objects: CollisionObject, restart: bool = False) -> str:
        if restart:
            monitor.follow("g", "1")
        return monitor.find_obstruction(scene(*objects), 0.0)

    away = next(d for d in np.arange(0.0, 0.2, 0.001) if not obstruction(item("mug", up(AT_HALF, -d)), restart=True))
    assert obstruction(item("mug", AT_HALF))
    assert obstruction(item("mug", up(AT_HALF, -away))), "a tiny distance is not enough"
    assert obstruction(item("mug", up(AT_HALF, -away - 0.007))) == ""
    bowl = item("bowl", up(AT_HALF, -away))  # never obstructing, but within the clear distance
    assert obstruction(bowl, restart=True) == ""
    assert obstruction(bowl, item("mug", AT_HALF)).startswith("mug ") and obstruction(bowl) == ""
