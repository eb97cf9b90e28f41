"""Cameras and pictures from messages: camera info, tf, images and depth images."""

import numpy as np
import pytest

from common.config import CameraConfig
from common.messages import Header, TFMessage, TransformStamped
from common.perception.camera_input import CameraCache, FrameError, decode_color_image, decode_image, resolve_camera
from common.perception.depth import DepthError, Rays, check_depth, depth_of, point_cloud
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole
from common.robot.transforms import matrix_to_pose
from tests.applications.outlining.outline_scenes import seen_world

CAMERA = Pinhole.from_config(CameraConfig(width=32, height=24, cx=16, cy=12))
HEADER = Header(frame_id="camera")
INFO = CAMERA.info(Header(frame_id="optical"))
PICTURE = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
IMAGE = array_to_image(PICTURE, "bgr8")


def tf_of(T) -> TFMessage:
    pose = TransformStamped(header=Header(frame_id="world"), child_frame_id="optical", transform=matrix_to_pose(T))
    return TFMessage(transforms=[pose])


TF = tf_of(CAMERA.T_world_optical)


def test_camera_is_resolved_from_camera_info_and_tf():
    for frame in ("", "optical"):
        made = resolve_camera(INFO, TF, frame)
        np.testing.assert_allclose(made.T_world_optical, CAMERA.T_world_optical, atol=1e-12)
        assert (made.fx, made.cx, made.width) == (520, 16, 32)


def test_camera_cache_resolves_again_only_for_new_messages():
    cameras = CameraCache()
    first = cameras.of(INFO, TF)
    assert cameras.of(INFO, TF) is first
    moved = CAMERA.T_world_optical.copy()
    moved[0, 3] += 0.1
    np.testing.assert_allclose(cameras.of(INFO, tf_of(moved)).T_world_optical, moved, atol=1e-12)
    with pytest.raises(FrameError):
        cameras.of(INFO, None)


@pytest.mark.parametrize(("arguments", "kind", "text"), [
    ((None, TF), "unknown_camera", "no camera_info received yet"),
    ((INFO, None), "unknown_camera", "no tf_static received yet"),
    ((INFO, TF, "elsewhere"), "unknown_frame", "no frame 'elsewhere'; its frames: optical"),
    ((INFO, TFMessage(transforms=[])), "unknown_frame", "its frames: none"),
    ((INFO.model_copy(update={"d": [0.1]}), TF), "camera", "distortion"),
])
def test_missing_or_invalid_message_is_named(arguments, kind, text):
    with pytest.raises(FrameError, match=text) as caught:
        resolve_camera(*arguments)
    assert caught.value.kind == kind


def test_decoded_image_is_bgr_for_any_channel_order():
    np.testing.assert_array_equal(decode_image(IMAGE, CAMERA), PICTURE)
    np.testing.assert_array_equal(decode_image(array_to_image(PICTURE, "rgb8"), CAMERA), PICTURE[..., ::-1])


@pytest.mark.parametrize(("change", "kind"), [
    ({"width": 24, "height": 32}, "size"), ({"encoding": "32FC1"}, "encoding"), ({"encoding": "jpeg"}, "encoding"),
    ({"data": bytes(2303)}, "truncated"), ({"step": 97, "data": bytes(9999)}, "step"),
])
def test_undecodable_image_reports_its_kind(change, kind):
    with pytest.raises(FrameError) as caught:
        decode_image(IMAGE.model_copy(update=change), CAMERA)
    assert caught.value.kind == kind


def test_depth_in_meters_and_millimeters_is_equal():
    metres = np.array([[1.5, np.nan], [0.75, 2.0]], np.float32)
    np.testing.assert_array_equal(depth_of(array_to_image(metres, "32FC1", HEADER)), metres)
    millimetres = np.array([[1500, 0], [750, 2000]], np.uint16)
    np.testing.assert_allclose(depth_of(array_to_image(millimetres, "16UC1", HEADER)), metres)


def test_message_without_depth_or_color_is_rejected():
    depth = array_to_image(np.zeros((2, 2), np.float32), "32FC1", HEADER)
    for decode, image, text in (
        (depth_of, IMAGE, "'bgr8' is no depth image; choices: 32FC1, 16UC1"),
        (depth_of, depth.model_copy(update={"data": b"abc"}), "too few"),
        (decode_color_image, depth, "is no color image"),
    ):
        with pytest.raises(FrameError, match=text):
            decode(image)


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
