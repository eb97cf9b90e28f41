"""What a depth camera measures, as points and colours; how far the tool gets; the shapes that may not collide."""

from __future__ import annotations

import numpy as np
import pytest
from common.perception.intake import Unusable
from page.layers.points import thinned
from page.layers.reach import shell_of

from common import topics
from common.messages import Header, Image, PointCloud2
from common.perception.depth import point_cloud
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole
from page.camera_panel import depth_image_colors
from page.nodes import brightened
from tests.page.scene_cell import Stage, around_of, in_world, robot_of


def cloud_of(camera: Pinhole) -> PointCloud2:
    depth = np.full((camera.height, camera.width), 0.5, np.float32)
    depth[:20] = np.nan
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    picture[..., 2] = 200
    return point_cloud(picture, depth, camera, Header(stamp=1, frame_id="camera_optical_frame"))


def test_cloud_is_thinned_evenly_and_keeps_its_colours(panda: Stage) -> None:
    camera = Pinhole.from_config(around_of("panda").camera)
    found = thinned(cloud_of(camera), 2000)
    assert found is not None
    points, colors = found
    assert 1000 < len(points) <= 2000 and (points[:, 2] == 0.5).all()
    assert (colors == [200, 0, 0]).all()
    spread = np.abs(points[:, 0]).max() / (0.5 * camera.width / 2 / camera.fx)
    assert spread == pytest.approx(1, abs=0.1)


def test_cloud_whose_bytes_do_not_add_up_is_left_out() -> None:
    cloud = cloud_of(Pinhole.from_config(around_of("panda").camera))
    assert thinned(cloud.model_copy(update={"data": cloud.data[:-100]})) is None
    assert thinned(cloud.model_copy(update={"fields": ["x", "y"]})) is None
    assert thinned(cloud.model_copy(update={"point_step": 6})) is None


def test_cloud_lies_where_its_camera_is(panda: Stage) -> None:
    camera = Pinhole.from_config(around_of("panda").camera)
    panda.show("points", True)
    panda.say(topics.DEPTH_CAMERA_POINTS, cloud_of(camera))
    node = panda.layer("points").nodes[topics.DEPTH_CAMERA_POINTS.key]
    np.testing.assert_allclose(in_world(panda.server, node), camera.T_world_optical, atol=1e-6)


def test_near_depths_are_red_far_ones_blue_and_none_black() -> None:
    depth = np.linspace(0.4, 1.2, 4000, dtype=np.float32).reshape(40, 100)
    depth[20, 50] = np.nan
    picture, said = depth_image_colors(array_to_image(depth, "32FC1"))
    first, last = picture[0, 0].astype(int), picture[-1, -1].astype(int)
    assert first[0] > 100 > first[2] and last[2] > last[0]
    assert picture[20, 50].tolist() == [0, 0, 0]
    assert said == "red 0.416 m, blue 1.184 m and farther"
    with pytest.raises(Unusable, match="is no depth image"):
        depth_image_colors(Image(header=Header(), height=2, width=2, encoding="bgr8", data=bytes(12)))


def test_black_gripper_is_seen_and_colours_stay_what_they_are() -> None:
    assert brightened((38, 38, 41)) == (61, 61, 64)
    assert brightened((0, 0, 255)) == (0, 0, 255)


@pytest.mark.parametrize("cell", ["panda", "ur5"])
def test_tool_is_never_outside_of_its_reach(cell: str) -> None:
    robot = robot_of(cell)
    shell = shell_of(robot)
    assert shell is not None
    rng = np.random.default_rng(5)
    middle = shell.profile[[0, -1], 1].mean()
    angles = np.arctan2(shell.profile[:, 1] - middle, shell.profile[:, 0])
    limit = np.hypot(shell.profile[:, 0], shell.profile[:, 1] - middle)
    for q in rng.uniform(robot.lower, robot.upper, (2000, robot.dof)):
        p = np.linalg.inv(shell.T_world_axis) @ robot.fk(q)[:, 3]
        r, z = np.hypot(p[0], p[1]), p[2] - middle
        assert np.hypot(r, z) <= np.interp(np.arctan2(z, r), angles, limit) + 0.06
    assert limit.max() < robot.reach + 0.01


def test_collision_shapes_are_read_when_they_are_first_looked_at_and_follow_the_arm(panda: Stage) -> None:
    layer = panda.layer("collision_shapes")
    home = panda.robot.named("home")
    panda.joints(home)
    assert layer.figure is None
    panda.show("collision_shapes", True)
    panda.joints(home + 0.1)
    link = panda.robot.config.tcp_link
    last = next(name for name in reversed(list(layer.figure.links)) if name in panda.robot.link_names)
    np.testing.assert_allclose(in_world(panda.server, layer.figure.links[last]),
                               panda.robot.link_poses(home + 0.1)[last], atol=1e-6)
    assert link in panda.robot.link_names
