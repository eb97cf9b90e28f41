"""What is stored of a picture is of that one, however the next ones count."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from common import messages as m
from common import topics
from common.applications.outlining import stage_files
from common.applications.outlining.asking import store
from common.applications.outlining.messages import Contour, Contours, OutlinePoints
from common.applications.outlining.topics import CONTOUR_PATH, CONTOUR_POINTS, CONTOURS
from common.perception.image import array_to_image
from common.transport.local import LocalNetwork

RIGHT, WRONG = [(1.0, 1.0), (2.0, 1.0), (2.0, 2.0)], [(7.0, 7.0), (8.0, 7.0), (8.0, 8.0)]


def header(stamp: int) -> m.Header:
    return m.Header(stamp=stamp, frame_id="camera")


def contours(stamp: int, pixels: list[tuple[float, float]]) -> Contours:
    found = Contour(index=0, label="Object_0", pixels=pixels)
    return Contours(header=header(stamp), width=16, height=12, contours=[found], selected=0)


def outline(stamp: int, x: float) -> OutlinePoints:
    places = [m.Vector3(x=x, y=y, z=1.0) for y in (0.0, 0.1, 0.2)]
    return OutlinePoints(header=header(stamp), poses=[m.Pose(position=at) for at in places], object="Object_0")


@pytest.mark.parametrize("path_is", ["first", "last"])
async def test_stages_are_those_of_the_picture_of_the_path(tmp_path: Path, path_is: str) -> None:
    """Three services tell of one picture: what they say comes in any order."""
    bus = LocalNetwork().bus()
    picture, depth = bus.writer(topics.DEPTH_CAMERA_IMAGE), bus.writer(topics.DEPTH_CAMERA_DEPTH)
    seen, found, paths = bus.writer(CONTOURS), bus.writer(CONTOUR_POINTS), bus.writer(CONTOUR_PATH)

    async def soon() -> None:
        for _ in range(20):
            await asyncio.sleep(0)

    storing = asyncio.create_task(store(bus, tmp_path, None))
    await soon()
    for stamp in (1, 2):
        depth.put(array_to_image(np.full((12, 16), 0.5, np.float32), "32FC1", header(stamp)))
        await soon()
        picture.put(array_to_image(np.zeros((12, 16, 3), np.uint8), "bgr8", header(stamp)))
        await soon()
    if path_is == "first":
        paths.put(outline(2, 0.5))
        await soon()
    for stamp, pixels, x in ((2, RIGHT, 0.5), (3, WRONG, 0.9)):
        seen.put(contours(stamp, pixels))
        found.put(outline(stamp, x))
        await soon()
    if path_is == "last":
        paths.put(outline(2, 0.5))
    said = await storing
    assert said.startswith("Object_0, 3 points")
    assert stage_files.read_pixels(tmp_path / stage_files.PIXELS).tolist() == [list(each) for each in RIGHT]
    assert stage_files.read_coordinates(tmp_path / stage_files.COORDINATES)[:, 0].tolist() == [0.5] * 3
