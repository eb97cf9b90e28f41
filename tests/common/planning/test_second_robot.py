import numpy as np
import pytest

from common.messages import Header
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from tests.common.planning.ur5_scene import HOME, PIPELINE, ROBOT, SCENE, TOP, tip_at, to_home, to_pose


def ends_at(response) -> np.ndarray:
    assert response.ok, response.message
    return np.array(response.trajectory.points[-1].positions)


def free_again(request, response) -> bool:
    world = PIPELINE.world(request, SCENE, request.start)
    path, _ = fine_samples(timed_path(response.trajectory), 0.005)
    return not any(world.collides(q) for q in path)


@pytest.mark.parametrize("name", ["home", "default"])
def test_named_poses_are_free_beside_the_block(name):
    world = PIPELINE.world(to_home(HOME), SCENE, HOME)
    assert world.colliding_pair(ROBOT.named(name)) is None


def test_it_goes_above_the_block_draws_a_line_and_comes_home():
    there = to_pose(tip_at(0.5, 0.2, TOP + 0.15), HOME)
    move = PIPELINE.plan(there, SCENE)
    above = ends_at(move)
    assert np.allclose(ROBOT.fk(above), tip_at(0.5, 0.2, TOP + 0.15), atol=1e-3)

    across = to_pose(tip_at(0.5, -0.2, TOP + 0.01), above, straight=True)
    line = PIPELINE.plan(across, SCENE)
    over = ends_at(line)
    assert free_again(there, move) and free_again(across, line)
    points = np.array([ROBOT.fk(p.positions)[:3, 3] for p in line.trajectory.points])
    begin, way = points[0], points[-1] - points[0]
    off = np.cross(points - begin, way / np.linalg.norm(way))
    assert np.linalg.norm(off, axis=1).max() < 1e-4 and np.abs(points[-1] - (0.5, -0.2, TOP + 0.01)).max() < 1e-4

    assert np.allclose(ends_at(PIPELINE.plan(to_home(over), SCENE)), HOME, atol=1e-6)


def test_speeds_stay_within_the_limits_of_the_robot_file():
    response = PIPELINE.plan(to_pose(tip_at(0.5, 0.2, TOP + 0.15), HOME), SCENE)
    speeds = np.array([p.velocities for p in response.trajectory.points])
    accelerations = np.array([p.accelerations for p in response.trajectory.points])
    assert (np.abs(speeds) <= 0.2 * np.pi * 1.001).all() and (np.abs(accelerations) <= 0.2 * 5.0 * 1.001).all()


def test_fingers_that_would_enter_the_block_are_refused_with_the_pair():
    above = ends_at(PIPELINE.plan(to_pose(tip_at(0.5, 0.0, TOP + 0.1), HOME), SCENE))
    response = PIPELINE.plan(to_pose(tip_at(0.5, 0.0, TOP - 0.02), above, straight=True), SCENE)
    assert response.error == "collision" and response.colliding is not None
    assert response.colliding[0].startswith("robotiq_85") and response.colliding[1] == "target_base"


def test_scene_in_the_frame_of_a_base_that_stands_elsewhere_is_refused():
    scene = SCENE.model_copy(update={"header": Header(frame_id="base_link")})
    response = PIPELINE.plan(to_home(ROBOT.named("default")), scene)
    assert response.error == "bad_scene" and "base_link" in response.message
