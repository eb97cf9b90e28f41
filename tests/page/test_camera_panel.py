"""Image messages as RGB images of the page."""

import numpy as np
import pytest

from common.messages import Header, Image
from common.perception.camera_input import FrameError
from common.perception.image import ImageError, array_to_image
from page.camera_panel import depth_image_colors, rgb_image


def test_image_has_its_colors_and_at_most_the_displayed_width() -> None:
    bgr = np.zeros((100, 1000, 3), np.uint8)
    bgr[:, :, 2] = 200
    rgb = rgb_image(array_to_image(bgr, "bgr8"), 500)
    assert rgb.shape == (50, 500, 3) and rgb[25, 250].tolist() == [200, 0, 0]
    same = rgb_image(array_to_image(bgr[:, :, ::-1], "rgb8"))
    assert same[50, 50].tolist() == [200, 0, 0]
    gray = rgb_image(array_to_image(np.full((4, 4), 7, np.uint8), "mono8"))
    assert gray.shape == (4, 4, 3) and gray[0, 0].tolist() == [7, 7, 7]


@pytest.mark.parametrize(("encoding", "data"), [("bgr8", b"short"), ("32FC1", bytes(64)), ("jpeg", b"")])
def test_invalid_image_is_rejected(encoding: str, data: bytes) -> None:
    with pytest.raises(ImageError):
        rgb_image(Image(header=Header(), height=4, width=4, encoding=encoding, data=data))


def test_near_depth_is_red_far_depth_blue_and_missing_depth_black() -> None:
    depth = np.linspace(0.4, 1.2, 4000, dtype=np.float32).reshape(40, 100)
    depth[20, 50] = np.nan
    rgb, text = depth_image_colors(array_to_image(depth, "32FC1"))
    first, last = rgb[0, 0].astype(int), rgb[-1, -1].astype(int)
    assert first[0] > 100 > first[2] and last[2] > last[0]
    assert rgb[20, 50].tolist() == [0, 0, 0]
    assert text == "red: 0.416 m, blue: 1.184 m or more, black: no depth"
    with pytest.raises(FrameError, match="is no depth image"):
        depth_image_colors(Image(header=Header(), height=2, width=2, encoding="bgr8", data=bytes(12)))
