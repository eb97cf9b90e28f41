"""The panel with the pictures of the camera: as it sends them, with what was found in them, and what is behind that."""

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
from page.console import Desk
from page.feeds import ANNOTATED, DEPTH, LIVE, MASK
from page.markup import block, span

WIDEST = 640  # [px] that are sent: more than the panel shows
QUALITY = 75
LABELS = {ANNOTATED: "With what was found", LIVE: "As it comes", MASK: "What its colours let through", DEPTH: "Depth"}
NEAREST, FARTHEST = 2, 98  # [%] of the depths between which colours are spread: a single wrong one says nothing

Picture = NDArray[np.uint8]


def rgb_picture(image: Image, widest: int = WIDEST) -> Picture:
    """The picture of a message as (height, width, 3) RGB, at most `widest` pixels wide.

    Raises:
        ImageError: the message contradicts itself, or is no picture to look at.
    """
    import cv2  # only when there is a picture: the page is to be there soon

    array: NDArray[Any] = image_to_array(image)
    if array.dtype != np.uint8:
        raise ImageError("encoding", f"{image.encoding} is no picture to look at")
    if array.shape[1] > widest:
        height = max(1, round(array.shape[0] * widest / array.shape[1]))
        array = cv2.resize(array, (widest, height), interpolation=cv2.INTER_AREA)
    if array.ndim == 2:
        return np.asarray(cv2.cvtColor(array, cv2.COLOR_GRAY2RGB), np.uint8)
    return np.asarray(array[:, :, ::-1] if image.encoding == "bgr8" else array, np.uint8)


def depth_picture(image: Image, widest: int = WIDEST) -> tuple[Picture, str]:
    """Depths as colours, (height, width, 3) RGB, near ones red, far ones blue, none black; and in words from where to
    where.

    Raises:
        FrameError: the message is no depth image.
    """
    import cv2

    from common.perception.depth import depth_of, is_valid

    step = max(1, math.ceil(image.width / widest))
    depth = depth_of(image)[::step, ::step]
    valid = is_valid(depth)
    if not valid.any():
        return np.zeros((*depth.shape, 3), np.uint8), "nothing within range"
    near, far = (float(value) for value in np.percentile(depth[valid], (NEAREST, FARTHEST)))
    share = (far - np.where(valid, depth, far)) / max(far - near, 1e-6)
    colours = cv2.applyColorMap((255 * np.clip(share, 0, 1)).astype(np.uint8), cv2.COLORMAP_TURBO)
    colours[~valid] = 0
    return np.ascontiguousarray(colours[:, :, ::-1]), f"red {near:.3f} m, blue {far:.3f} m and farther"


class PicturePanel:
    """Pictures of several kinds, each with a tick: what is not ticked is not even asked for."""

    def __init__(
        self, gui: viser.GuiApi, desk: Desk, shown: dict[str, bool], on_shown: Callable[[], None]
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            desk: takes changes of the ticks.
            shown: whether each kind is ticked; one that is not named is not.
            on_shown: called when that has changed.
        """
        self._gui = gui
        self.shown = dict.fromkeys(LABELS, False) | shown
        self._on_shown = on_shown
        self._ticks = {name: gui.add_checkbox(label, self.shown[name]) for name, label in LABELS.items()}
        self._folders = {name: gui.add_folder(None, visible=self.shown[name]) for name in LABELS}
        self._images: dict[str, dict[str, viser.GuiImageHandle]] = {name: {} for name in LABELS}  # each by its source
        self._notes: dict[str, viser.GuiHtmlHandle] = {}
        for name, tick in self._ticks.items():
            desk.on_change(tick, partial(self._set_shown, name), "look")
            with self._folders[name]:
                self._notes[name] = gui.add_html(block(span("No picture yet", "dim"), f"{name} picture", pictures=0))
        self._count = dict.fromkeys(LABELS, 0)

    def offer(self, there: Collection[str]) -> None:
        """Have ticks for those kinds only that are there."""
        for name, tick in self._ticks.items():
            if tick.visible is not (has := name in there):
                tick.visible = has
                self._folders[name].visible = self.shown[name] and has

    def show(self, name: str, image: Image, source: str) -> Picture | None:
        """Show a message as a picture of a kind; the picture, or None when it is none.

        Args:
            name: of the kind.
            image: the message.
            source: the key under which it came; several stand below one another, with their keys.
        """
        said = ""
        try:
            if name == DEPTH and image.encoding not in ("rgb8", "bgr8"):  # else it was coloured before
                rgb, said = depth_picture(image)
            else:
                rgb = rgb_picture(image)
        except (ImageError, FrameError) as error:
            self._notes[name].content = block(span(error, "bad"), f"{name} picture", pictures=self._count[name])
            return None
        self._count[name] += 1
        images = self._images[name]
        note = block(span(said, "dim"), f"{name} picture", pictures=self._count[name]) if said else ""
        if self._notes[name].content != note:
            self._notes[name].content = note
        if source in images:
            images[source].image = rgb
            return rgb
        with self._folders[name]:
            images[source] = self._gui.add_image(rgb, format="jpeg", jpeg_quality=QUALITY, visible=self.shown[name])
        if len(images) > 1:
            for key, handle in images.items():
                handle.label = key
        return rgb

    def _set_shown(self, name: str, on: bool) -> None:
        self.shown[name] = on
        self._folders[name].visible = on
        for handle in self._images[name].values():
            handle.visible = on
        self._on_shown()
