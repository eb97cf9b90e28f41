import numpy as np
import pytest

from common.config import CameraConfig
from common.messages import Header, Image, TFMessage, TransformStamped
from common.perception.camera_input import CameraCache, FrameError, decode_image, resolve_camera
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole
from common.robot.transforms import matrix_to_pose

camera = Pinhole.from_config(CameraConfig(width=32, height=24, cx=16, cy=12))
info = camera.info(Header(frame_id="optical"))
tf = TFMessage(
    transforms=[
        TransformStamped(
            header=Header(frame_id="world"), child_frame_id="optical", transform=matrix_to_pose(camera.T_world_optical)
        )
    ]
)


def test_camera_is_resolved_from_camera_info_and_tf():
    for frame in ("", "optical"):
        made = resolve_camera(info, tf, frame)
        np.testing.assert_allclose(made.T_world_optical, camera.T_world_optical, atol=1e-12)
        assert (made.fx, made.cx, made.width) == (520, 16, 32)


def test_camera_cache_resolves_again_only_for_new_messages():
    cameras = CameraCache()
    first = cameras.of(info, tf)
    assert cameras.of(info, tf) is first
    moved = camera.T_world_optical.copy()
    moved[0, 3] += 0.1
    transform = tf.transforms[0].model_copy(update={"transform": matrix_to_pose(moved)})
    np.testing.assert_allclose(cameras.of(info, TFMessage(transforms=[transform])).T_world_optical, moved, atol=1e-12)
    with pytest.raises(FrameError):
        cameras.of(info, None)


@pytest.mark.parametrize(
    ("arguments", "kind", "told"),
    [
        ((None, tf), "unknown_camera", "no camera_info received yet"),
        ((info, None), "unknown_camera", "no tf_static received yet"),
        ((info, tf, "elsewhere"), "unknown_frame", "no frame 'elsewhere'; its frames: optical"),
        ((info, TFMessage(transforms=[])), "unknown_frame", "its frames: none"),
        ((info.model_copy(update={"d": [0.1]}), tf), "camera", "distortion"),
    ],
)
def test_missing_or_invalid_message_is_named(arguments, kind, told):
    with pytest.raises(FrameError, match=told) as caught:
        resolve_camera(*arguments)
    assert caught.value.kind == kind


def test_decoded_image_is_bgr_for_any_channel_order():
    pixels = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    np.testing.assert_array_equal(decode_image(array_to_image(pixels, "bgr8"), camera), pixels)
    np.testing.assert_array_equal(decode_image(array_to_image(pixels, "rgb8"), camera), pixels[..., ::-1])


@pytest.mark.parametrize(
    ("image", "kind"),
    [
        (Image(header=Header(), width=1, height=1, encoding="bgr8", data=bytes(3)), "size"),
        (Image(header=Header(), width=24, height=32, encoding="bgr8", data=bytes(2304)), "size"),
        (Image(header=Header(), width=32, height=24, encoding="32FC1", data=bytes(3072)), "encoding"),
        (Image(header=Header(), width=32, height=24, encoding="jpeg", data=bytes(3072)), "encoding"),
        (Image(header=Header(), width=32, height=24, encoding="bgr8", data=bytes(2303)), "truncated"),
        (Image(header=Header(), width=32, height=24, encoding="bgr8", step=97, data=bytes(9999)), "step"),
    ],
)
def test_undecodable_image_reports_its_kind(image, kind):
    with pytest.raises(FrameError) as caught:
        decode_image(image, camera)
    assert caught.value.kind == kind
