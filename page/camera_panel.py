"""The Cameras tab: live image, detections overlay, color mask and depth image of each camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from common.messages import Image
from common.perception.camera_input import FrameError
from common.perception.image import ImageError, image_to_array
from page.console import ActionQueue
from page.feeds import ANNOTATED, DEPTH, LIVE, MASK
from page.markup import Html, block, span

MAX_WIDTH = 640  # [px] of images that are sent: more than the panel shows
JPEG_QUALITY = 75
LABELS = {ANNOTATED: "Detections overlay", LIVE: "Live image", MASK: "Color mask", DEPTH: "Depth image"}
LOW, HIGH = 2, 98  # [%] percentiles of depth at the ends of the color map, so that outliers have no effect

RgbImage = NDArray[np.uint8]  # (height, width, 3)


def rgb_image(image: Image, max_width: int = MAX_WIDTH) -> RgbImage:
    """Return an image message as (height, width, 3) RGB, scaled down to `max_width` pixels.

    Raises:
        ImageError: the message is inconsistent, or is no 8-bit image.
    """
    import cv2  # slow to import, and needed with an image only

    array: NDArray[Any] = image_to_array(image)
    if array.dtype != np.uint8:
        raise ImageError("encoding", f"{image.encoding} cannot be displayed as an image")
    if array.shape[1] > max_width:
        height = max(1, round(array.shape[0] * max_width / array.shape[1]))
        array = cv2.resize(array, (max_width, height), interpolation=cv2.INTER_AREA)
    if array.ndim == 2:
        return np.asarray(cv2.cvtColor(array, cv2.COLOR_GRAY2RGB), np.uint8)
    return np.asarray(array[:, :, ::-1] if image.encoding == "bgr8" else array, np.uint8)


def depth_image_colors(image: Image, max_width: int = MAX_WIDTH) -> tuple[RgbImage, str]:
    """Return depth as colors (height, width, 3) RGB, red to blue, black without a value; and a text of the range.

    Raises:
        FrameError: the message is no depth image.
    """
    import cv2

    from common.perception.depth import depth_of, is_valid

    step = max(1, math.ceil(image.width / max_width))
    depth = depth_of(image)[::step, ::step]
    valid = is_valid(depth)
    if not valid.any():
        return np.zeros((*depth.shape, 3), np.uint8), "no depth within range"
    near, far = (float(value) for value in np.percentile(depth[valid], (LOW, HIGH)))
    fraction = (far - np.where(valid, depth, far)) / max(far - near, 1e-6)
    colors = cv2.applyColorMap((255 * np.clip(fraction, 0, 1)).astype(np.uint8), cv2.COLORMAP_TURBO)
    colors[~valid] = 0
    return np.ascontiguousarray(colors[:, :, ::-1]), f"red: {near:.3f} m, blue: {far:.3f} m or more, black: no depth"


class CameraPanel:
    """Images of several kinds, each with a checkbox; a kind that is switched off is not even read."""

    def __init__(
        self, gui: viser.GuiApi, actions: ActionQueue, shown: dict[str, bool], on_shown: Callable[[], None]
    ) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            actions: runs changes of the checkboxes.
            shown: initial state of each kind; a kind that is not listed is off.
            on_shown: called after a change.
        """
        self._gui = gui
        self.shown = dict.fromkeys(LABELS, False) | shown
        self._on_shown = on_shown
        self._checkboxes = {name: gui.add_checkbox(label, self.shown[name]) for name, label in LABELS.items()}
        self._folders = {name: gui.add_folder(None, visible=self.shown[name]) for name in LABELS}
        self._images: dict[str, dict[str, viser.GuiImageHandle]] = {name: {} for name in LABELS}  # by topic key
        self._notes: dict[str, Html] = {}
        for name, checkbox in self._checkboxes.items():
            actions.on_change(checkbox, partial(self._set_shown, name), "look")
            with self._folders[name]:
                self._notes[name] = Html(
                    gui, block(span(f"{LABELS[name]}: no image received", "dim"), f"{name} picture", pictures=0))
        self._count = dict.fromkeys(LABELS, 0)

    def offer(self, available: Collection[str]) -> None:
        """Show only the checkboxes of these kinds."""
        for name, checkbox in self._checkboxes.items():
            if checkbox.visible is not (offered := name in available):
                checkbox.visible = offered
                self._folders[name].visible = self.shown[name] and offered

    def show(self, name: str, image: Image, key: str) -> RgbImage | None:
        """Display a message as an image of a kind; return the image, or None for an invalid message.

        Args:
            name: of the kind.
            image: the message.
            key: of its topic; images of several topics are displayed below one another, labeled with their keys.
        """
        note = ""
        try:
            if name == DEPTH and image.encoding not in ("rgb8", "bgr8"):  # otherwise it is a color image already
                rgb, note = depth_image_colors(image)
            else:
                rgb = rgb_image(image)
        except (ImageError, FrameError) as error:
            self._notes[name].set(block(span(error, "bad"), f"{name} picture", pictures=self._count[name]))
            return None
        self._count[name] += 1
        images = self._images[name]
        self._notes[name].set(
            block(span(note, "dim"), f"{name} picture", pictures=self._count[name]) if note else "")
        if key in images:
            images[key].image = rgb
            return rgb
        with self._folders[name]:
            images[key] = self._gui.add_image(
                rgb, format="jpeg", jpeg_quality=JPEG_QUALITY, visible=self.shown[name])
        if len(images) > 1:
            for other, handle in images.items():
                handle.label = other
        return rgb

    def _set_shown(self, name: str, on: bool) -> None:
        self.shown[name] = on
        self._folders[name].visible = on
        for handle in self._images[name].values():
            handle.visible = on
        self._on_shown()
