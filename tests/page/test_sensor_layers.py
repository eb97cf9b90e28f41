"""Point clouds, the reachable workspace, and collision shapes in the scene."""

import numpy as np
import pytest

from common import topics
from common.messages import Header, PointCloud2
from common.perception.depth import point_cloud
from common.perception.pinhole import Pinhole
from page.layers.frames import thin_out
from page.layers.robot import sample_workspace
from tests.page.scene_cell import Stage, around_of, in_world, robot_of

CAMERA = Pinhole.from_config(around_of("panda").camera)


def cloud(**changes: object) -> PointCloud2:
    depth = np.full((CAMERA.height, CAMERA.width), 0.5, np.float32)
    depth[:20] = np.nan
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    image[..., 2] = 200
    found = point_cloud(image, depth, CAMERA, Header(stamp=1, frame_id="camera_optical_frame"))
    return found.model_copy(update=changes)


def test_cloud_is_thinned_out_evenly_with_its_colors() -> None:
    found = thin_out(cloud(), 2000)
    points, colors = found
    assert 1000 < len(points) <= 2000 and (points[:, 2] == 0.5).all()
    assert (colors == [200, 0, 0]).all()
    spread = np.abs(points[:, 0]).max() / (0.5 * CAMERA.width / 2 / CAMERA.fx)
    assert spread == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("change", [{"data": b"short"}, {"fields": ["x", "y"]}, {"point_step": 6}])
def test_inconsistent_cloud_is_left_out(change: dict[str, object]) -> None:
    assert thin_out(cloud(**change)) is None


def test_cloud_is_displayed_in_the_frame_of_its_camera(panda: Stage) -> None:
    panda.show("points", True)
    panda.say(topics.DEPTH_CAMERA_POINTS, cloud())
    node = panda.layer("points").nodes[topics.DEPTH_CAMERA_POINTS.key]
    np.testing.assert_allclose(in_world(panda.server, node), CAMERA.T_world_optical, atol=1e-6)


@pytest.mark.parametrize("cell", ["panda", "ur5"])
def test_tool_never_leaves_its_reachable_workspace(cell: str) -> None:
    robot = robot_of(cell)
    workspace = sample_workspace(robot)
    rng = np.random.default_rng(5)
    middle = workspace.profile[[0, -1], 1].mean()
    angles = np.arctan2(workspace.profile[:, 1] - middle, workspace.profile[:, 0])
    limit = np.hypot(workspace.profile[:, 0], workspace.profile[:, 1] - middle)
    for q in rng.uniform(robot.lower, robot.upper, (500, robot.dof)):
        p = np.linalg.inv(workspace.T_world_axis) @ robot.fk(q)[:, 3]
        r, z = np.hypot(p[0], p[1]), p[2] - middle
        assert np.hypot(r, z) <= np.interp(np.arctan2(z, r), angles, limit) + 0.06
    assert limit.max() < robot.reach + 0.01


def test_collision_shapes_are_loaded_when_shown_first_and_follow_the_arm(panda: Stage) -> None:
    layer, q = panda.layer("collision_shapes"), panda.robot.named("home") + 0.1
    panda.joints(panda.robot.named("home"))
    assert layer.figure is None
    panda.show("collision_shapes", True)
    panda.joints(q)
    last = next(name for name in reversed(list(layer.figure.links)) if name in panda.robot.link_names)
    np.testing.assert_allclose(in_world(panda.server, layer.figure.links[last]), panda.robot.link_poses(q)[last],
                               atol=1e-6)
