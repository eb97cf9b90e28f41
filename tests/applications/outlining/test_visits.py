"""Stored stages belong to one image, however later images are numbered."""

from __future__ import annotations

import asyncio
from pathlib import Path

import cv2
import numpy as np
import pytest

from applications.outlining import stage_files, visits
from applications.outlining.topics import (
    CONTOUR_IMAGE,
    CONTOUR_PATH,
    CONTOUR_POINTS,
    CONTOURS,
    OUTLINE_SELECT,
    Contour,
    Contours,
    OutlinePoints,
    OutlineSelect,
    OutlineSelection,
)
from applications.outlining.visits import ask_operator, store_stages
from common import messages as m
from common import topics
from common.errors import NoResponder, RequestLost
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


async def soon() -> None:
    for _ in range(20):
        await asyncio.sleep(0)


@pytest.mark.parametrize("path_is", ["first", "last"])
async def test_stored_stages_belong_to_the_image_of_the_path(tmp_path: Path, path_is: str) -> None:
    """Messages of three services about one image arrive in any order."""
    bus = LocalNetwork().bus()
    picture, depth = bus.writer(topics.DEPTH_CAMERA_IMAGE), bus.writer(topics.DEPTH_CAMERA_DEPTH)
    seen, found, paths = bus.writer(CONTOURS), bus.writer(CONTOUR_POINTS), bus.writer(CONTOUR_PATH)

    storing = asyncio.create_task(store_stages(bus, tmp_path, None))
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


async def test_operator_sees_the_image_of_the_requested_contours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An image of earlier contours comes first, and more arrive before the answer."""
    network = LocalNetwork()
    bus, detector = network.bus(), network.bus(service="contour_detector")
    seen, drawn = detector.writer(CONTOURS), detector.writer(CONTOUR_IMAGE)
    answers: asyncio.Queue[str] = asyncio.Queue()
    monkeypatch.setattr(visits, "_line", answers.get)
    chosen: list[OutlineSelect] = []

    async def select(wanted: OutlineSelect) -> OutlineSelection:
        chosen.append(wanted)
        return OutlineSelection(index=0, label="Object_0")

    detector.serve(OUTLINE_SELECT, select)
    await detector.ready()
    asked = asyncio.create_task(ask_operator(bus, tmp_path))
    await soon()
    for stamp, pixels in ((1, None), (2, RIGHT), (3, WRONG)):
        seen.put(contours(stamp, pixels) if pixels else Contours(header=header(stamp), width=16, height=12))
        await soon()
        drawn.put(array_to_image(np.full((12, 16, 3), 50 * stamp, np.uint8), "bgr8", header(stamp)))
        if stamp > 1:
            await soon()
    answers.put_nowait("0")
    async with asyncio.timeout(5):
        await asked
    shown = cv2.imread(str(tmp_path / "test_contours.png"))
    assert shown is not None
    middles = {100: (5 / 3, 4 / 3), 150: (23 / 3, 22 / 3)}
    assert chosen[0].at == pytest.approx(middles[int(shown[0, 0, 0])])


async def test_selection_with_lost_answer_is_repeated_and_an_unanswered_one_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    network = LocalNetwork()
    bus, detector = network.bus(), network.bus(service="contour_detector")
    seen, drawn = detector.writer(CONTOURS), detector.writer(CONTOUR_IMAGE)
    answers: asyncio.Queue[str] = asyncio.Queue()
    monkeypatch.setattr(visits, "_line", answers.get)
    choices = 0

    class Losing:
        async def call(self, _wanted: OutlineSelect) -> OutlineSelection:
            nonlocal choices
            choices += 1
            if choices <= visits.TRIES + 1:
                raise RequestLost(OUTLINE_SELECT.key)
            return OutlineSelection(index=0, label="Object_0")

        async def wait_available(self, _timeout: float) -> None:
            raise NoResponder(OUTLINE_SELECT.key)

    monkeypatch.setattr(bus, "client", lambda _topic: Losing())
    asked = asyncio.create_task(ask_operator(bus, tmp_path))
    await soon()
    seen.put(contours(1, RIGHT))
    drawn.put(array_to_image(np.zeros((12, 16, 3), np.uint8), "bgr8", header(1)))
    answers.put_nowait("0")
    answers.put_nowait("0")
    async with asyncio.timeout(5):
        await asked
    assert choices == visits.TRIES + 2
    said = capsys.readouterr().out
    assert said.count("outline which one?") == 2 and said.count("may have been carried out") == 1
    assert said.endswith("Object_0 is chosen\n")
