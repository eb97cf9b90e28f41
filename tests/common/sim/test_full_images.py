import coal
import numpy as np
import pytest

from common.config import RobotConfig, Surroundings, check, find_file, read_robot
from common.messages import Header, JointState
from common.robot.model import RobotModel
from common.sim.objects import world_object
from common.sim.rendering import ARM, Renderer, add_depth_noise
from common.sim.solids import robot_shapes, triangles
from tests.applications.outlining.outline_scenes import seen_world, world

AROUND = Surroundings.model_validate({f: getattr(world("w5"), f) for f in Surroundings.model_fields})
OBJECTS = [world_object(o) for o in world("w5").objects]
OVER = [0.1, -1.3, 1.6, -1.87, -1.57, 0.1]  # the hand above the objects


@pytest.fixture(scope="module")
def robot():
    return RobotModel.load(check(RobotConfig, read_robot(find_file("robots", "ur5"))))


@pytest.fixture
def view(robot):
    return Renderer(AROUND, robot)


def joints(robot, positions):
    return JointState(header=Header(), name=robot.joint_names, position=list(positions))


def is_arm(seen):
    return (np.abs(seen.colour.astype(int) - round(255 * ARM[0])) <= 1).all(axis=2)


def test_at_home_the_arm_is_not_before_the_objects(view, robot):
    seen = view.render(OBJECTS, joints(robot, robot.named("home")))
    assert not is_arm(seen).any()
    np.testing.assert_array_equal(seen.colour, seen_world("w5")[1])


def test_the_arm_hides_what_is_below_it_and_is_where_its_kinematics_say(view, robot):
    seen = view.render(OBJECTS, joints(robot, OVER))
    arm = is_arm(seen)
    assert arm.any() and seen.depth[arm].max() < 1.75
    wrist = robot.link_poses(OVER)["wrist_3_link"][:3, 3]
    u, v = np.rint(view.camera.project(wrist)).astype(int)
    assert arm[v, u] and seen.depth[v, u] == pytest.approx(2.75 - wrist[2], abs=0.12)


def test_only_what_changed_is_cast_again(view, robot):
    home = joints(robot, robot.named("home"))
    first = view.render(OBJECTS, home)
    assert view.render(OBJECTS, home.model_copy(update={"position": [p + 1e-6 for p in home.position]})) is first
    assert view.render(OBJECTS, joints(robot, OVER)) is not first
    fewer = view.render(OBJECTS[:1], home)
    assert fewer.depth.sum() > first.depth.sum() or np.nanmax(np.where(np.isfinite(fewer.depth), 0, 1)) == 1
    assert (fewer.colour != first.colour).any()


def test_without_a_whole_joint_state_there_is_no_arm(view, robot):
    part = JointState(header=Header(), name=robot.joint_names[:3], position=OVER[:3])
    assert not is_arm(view.render(OBJECTS, part)).any() and not is_arm(view.render(OBJECTS, None)).any()


def test_links_have_the_shapes_of_the_description(robot):
    shapes = robot_shapes(robot)
    assert {"forearm_link", "wrist_3_link", "robotiq_85_base_link"} <= set(shapes)
    forearm = shapes["forearm_link"].reshape(-1, 3)
    assert np.ptp(forearm, axis=0).max() == pytest.approx(0.45, abs=0.1)


@pytest.mark.parametrize("shape, size", [
    (coal.Box(0.1, 0.2, 0.3), (0.1, 0.2, 0.3)), (coal.Sphere(0.1), (0.2, 0.2, 0.2)),
    (coal.Cylinder(0.1, 0.5), (0.2, 0.2, 0.5)), (coal.Capsule(0.1, 0.5), (0.2, 0.2, 0.7))])
def test_primitive_shapes_have_their_size(shape, size):
    corners = triangles(shape).reshape(-1, 3)
    np.testing.assert_allclose(np.ptp(corners, axis=0), size, rtol=0.01)


def test_shapes_without_triangles_are_refused():
    with pytest.raises(ValueError, match="no triangles for a Halfspace"):
        triangles(coal.Halfspace(np.array([0.0, 0, 1]), 0.0))


def test_noise_and_missing_depth_are_as_asked_for():
    depth = np.full((200, 200), 1.5, np.float32)
    depth[0, 0] = np.nan
    noisy = add_depth_noise(depth, np.random.default_rng(1), 0.002, 0.1)
    assert np.isnan(noisy).mean() == pytest.approx(0.1, abs=0.01) and np.nanstd(noisy) == pytest.approx(0.002, rel=0.05)
    assert noisy.dtype == np.float32 and np.isnan(noisy[0, 0])
    np.testing.assert_array_equal(add_depth_noise(depth, np.random.default_rng(1), 0, 0), depth)
