"""Find the contours of objects in the image, and follow the selected one."""

from __future__ import annotations

import asyncio

import cv2
from pydantic import Field

from applications.outlining.contour_choice import ContourTracker, NoSuchContour, annotate_contours, parse_choice
from applications.outlining.contours import ContourOptions, Picture, find_contours
from applications.outlining.topics import (
    CONTOUR_IMAGE,
    CONTOURS,
    OUTLINE_SELECT,
    Contour,
    Contours,
    OutlineSelect,
    OutlineSelection,
)
from common import topics
from common.errors import ConfigError, Refused
from common.messages import Image
from common.perception.camera_input import FrameError, SkippedFrames, decode_color_image
from common.perception.image import array_to_image
from common.process.service import main
from common.transport.bus import Bus


class Config(ContourOptions):
    """How contours are found, and which one is selected at the start."""

    select: str | int = Field(
        "auto", description="at the start: none, auto (largest that does not touch the border), a colour, or an index"
    )


def initial_choice(select: str | int) -> OutlineSelect | None:
    """Return the selection at the start.

    Raises:
        ConfigError: it is invalid.
    """
    try:
        return parse_choice(select)
    except NoSuchContour as error:
        raise ConfigError("services.contour_detector.select", ..., str(error)) from None


async def run(bus: Bus, config: Config) -> None:
    """Process every image; unusable ones are dropped, counted and reported once."""
    images = bus.reader(topics.DEPTH_CAMERA_IMAGE)
    found, shown = bus.writer(CONTOURS), bus.writer(CONTOUR_IMAGE)
    cv2.setNumThreads(1)  # other services use the other cores
    following = ContourTracker(initial_choice(config.select))
    last: tuple[Image, Picture, list[Contour]] | None = None
    last_warning = ""
    left_out = SkippedFrames(bus.log, "image")

    def publish(selected: int, message: str) -> None:
        nonlocal last_warning
        if last is None:
            return
        image, picture, contours = last
        found.put(Contours(
            header=image.header, width=image.width, height=image.height, contours=contours, selected=selected,
            message=message,
        ))
        shown.put(array_to_image(annotate_contours(picture, contours, selected), "bgr8", image.header))
        if message and message != last_warning:
            bus.log.warning("%s", message)
        last_warning = message

    async def select(wanted: OutlineSelect) -> OutlineSelection:
        if last is None:
            raise Refused("no_picture", "no image received yet")
        try:
            contour = following.select(last[2], wanted)
        except NoSuchContour as error:
            raise Refused(error.code, str(error)) from None
        bus.log.info("%s is chosen", contour.label)
        publish(contour.index, "")
        return OutlineSelection(index=contour.index, label=contour.label)

    bus.serve(OUTLINE_SELECT, select)
    await bus.ready()
    async for image in images:
        try:
            picture = decode_color_image(image)
        except FrameError as error:
            left_out.note(error)
            continue
        last = (image, picture, await asyncio.to_thread(find_contours, picture, config.model_copy()))
        publish(*following.find(last[2]))


if __name__ == "__main__":
    main(run, Config)
