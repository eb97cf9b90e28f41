"""From an image message to a depth image in metres, or the reason why that can not be."""

from __future__ import annotations

import numpy as np

from common.messages import Image
from common.perception.depth import Depth
from common.perception.image import ImageError, image_to_array
from common.perception.intake import Unusable


def depth_of(image: Image) -> Depth:
    """The depth image (height, width) [m] of a message; 16UC1 is in millimetres with 0 for none, as in ROS.

    Raises:
        Unusable: it is no depth image, or its bytes do not add up.
    """
    if image.encoding not in ("32FC1", "16UC1"):
        raise Unusable("encoding", f"encoding {image.encoding!r} is no depth image; choices: 32FC1, 16UC1")
    try:
        values = image_to_array(image)
    except ImageError as error:
        raise Unusable(error.kind, str(error)) from None
    if image.encoding == "16UC1":
        return np.where(values > 0, values / np.float32(1000), np.float32(np.nan)).astype(np.float32)
    return np.asarray(values, np.float32)
