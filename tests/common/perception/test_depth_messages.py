import numpy as np
import pytest

from common.messages import Header
from common.perception.camera_input import FrameError, decode_color_image
from common.perception.depth import DepthError, Rays, check_depth, depth_of, point_cloud
from common.perception.image import array_to_image
from tests.applications.outlining.outline_scenes import seen_world

HEADER = Header(frame_id="camera")


def test_depth_in_meters_and_millimeters_is_equal():
    metres = np.array([[1.5, np.nan], [0.75, 2.0]], np.float32)
    np.testing.assert_array_equal(depth_of(array_to_image(metres, "32FC1", HEADER)), metres)
    millimetres = np.array([[1500, 0], [750, 2000]], np.uint16)
    np.testing.assert_allclose(depth_of(array_to_image(millimetres, "16UC1", HEADER)), metres)


def test_message_without_depth_is_rejected():
    picture = array_to_image(np.zeros((2, 2, 3), np.uint8), "bgr8", HEADER)
    with pytest.raises(FrameError, match="'bgr8' is no depth image; choices: 32FC1, 16UC1"):
        depth_of(picture)
    depth = array_to_image(np.zeros((2, 2), np.float32), "32FC1", HEADER)
    with pytest.raises(FrameError, match="too few"):
        depth_of(depth.model_copy(update={"data": b"abc"}))
    with pytest.raises(FrameError, match="is no color image"):
        decode_color_image(depth)


def test_wrong_size_and_missing_depth_are_reported():
    with pytest.raises(DepthError, match="the depth image is 5x4, but the color image is 5x3"):
        check_depth(np.ones((4, 5), np.float32), 5, 3)
    for value in (np.nan, np.inf, 0.0, -1.0):
        with pytest.raises(DepthError, match="no valid depth at all"):
            check_depth(np.full((4, 5), value, np.float32), 5, 4)
    check_depth(np.ones((4, 5), np.float32), 5, 4)


def test_ray_at_depth_is_the_point_projected_to_the_pixel():
    camera, _, _ = seen_world("w2")
    pixels = np.random.default_rng(0).uniform(0, (1024, 768), (50, 2))
    for points in (Rays.through(camera, pixels).at_depth(np.full(50, 1.4)),
                   Rays.through(camera, pixels).at_height(np.full(50, 1.1))):
        np.testing.assert_allclose(camera.project(points), pixels, atol=1e-9)
    np.testing.assert_allclose(points[:, 2], 1.1)
    u, v = 600.0, 300.0  # the convention of the cell: x = y_cam + 0.5, y = x_cam, z = 2.75 - depth
    point = Rays.through(camera, (u, v)).at_depth(1.5)
    np.testing.assert_allclose(point, [(v - 384) * 1.5 / camera.fy + 0.5, (u - 512) * 1.5 / camera.fx, 1.25], atol=1e-9)


def test_cloud_points_lie_on_their_rays_with_their_pixel_color():
    camera, picture, depth = seen_world("w5")
    cloud = point_cloud(picture, depth, camera, HEADER)
    rows = np.frombuffer(cloud.data, "<f4").reshape(cloud.height, cloud.width, 4)
    known = np.isfinite(depth)
    world = rows[..., :3][known] @ camera.T_world_optical[:3, :3].T + camera.position
    v, u = np.nonzero(known)
    np.testing.assert_allclose(camera.project(world), np.column_stack([u, v]), atol=1e-2)
    packed = np.ascontiguousarray(rows[..., 3]).view("<u4")
    np.testing.assert_array_equal(packed & 255, picture[..., 0])
    np.testing.assert_array_equal(packed >> 16, picture[..., 2])
