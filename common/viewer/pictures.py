"""The panel with the pictures of the camera: as it sends them, and with what was found in them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from common.messages import Image
from common.perception.image import ImageError, image_to_array
from common.viewer.console import Desk
from common.viewer.feeds import ANNOTATED, LIVE
from common.viewer.markup import block, span

WIDEST = 640  # [px] that are sent: more than the panel shows
QUALITY = 75
LABELS = {ANNOTATED: "With what was found", LIVE: "As it comes"}

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


class PicturePanel:
    """Two pictures, each with a tick: what is not ticked is not even asked for."""

    def __init__(
        self, gui: viser.GuiApi, desk: Desk, shown: dict[str, bool], on_shown: Callable[[], None]
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            desk: takes changes of the ticks.
            shown: whether the live and the annotated picture are ticked.
            on_shown: called when that has changed.
        """
        self._gui = gui
        self.shown = dict(shown)
        self._on_shown = on_shown
        self._ticks = {name: gui.add_checkbox(label, shown[name]) for name, label in LABELS.items()}
        self._folders = {name: gui.add_folder(None) for name in LABELS}
        self._images: dict[str, dict[str, viser.GuiImageHandle]] = {name: {} for name in LABELS}  # each by its source
        self._notes: dict[str, viser.GuiHtmlHandle] = {}
        for name, tick in self._ticks.items():
            desk.on_change(tick, partial(self._set_shown, name), "look")
            with self._folders[name]:
                self._notes[name] = gui.add_html(block(span("No picture yet", "dim"), f"{name} picture", pictures=0))
        self._count = dict.fromkeys(LABELS, 0)

    def show(self, name: str, image: Image, source: str) -> Picture | None:
        """Show a message as a live or an annotated picture; the picture, or None when it is none.

        Args:
            name: live or annotated.
            image: the message.
            source: the key under which it came; several stand below one another, with their keys.
        """
        try:
            rgb = rgb_picture(image)
        except ImageError as error:
            self._notes[name].content = block(span(error, "bad"), f"{name} picture", pictures=self._count[name])
            return None
        self._count[name] += 1
        images = self._images[name]
        if source in images:
            images[source].image = rgb
            return rgb
        self._notes[name].content = ""
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
