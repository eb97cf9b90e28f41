"""Visits to a running outlining cell: stored stages and prompts belong to one image."""

import asyncio

import cv2
import numpy as np
import pytest

from applications.outlining import stage_files, topics, visits
from applications.outlining.topics import OUTLINE_SELECT, Contour, Contours, OutlinePoints, OutlineSelection
from common import messages as m
from common.errors import NoResponder, RequestLost
from common.perception.image import array_to_image
from common.topics import DEPTH_CAMERA_DEPTH, DEPTH_CAMERA_IMAGE
from common.transport.local import LocalNetwork

RIGHT, WRONG = [(1.0, 1.0), (2.0, 1.0), (2.0, 2.0)], [(7.0, 7.0), (8.0, 7.0), (8.0, 8.0)]


async def turns():
    for _ in range(20):
        await asyncio.sleep(0)


class Cell:
    """Camera, contour detector and outline services of a cell, as far as visits use them."""

    def __init__(self, monkeypatch):
        network = LocalNetwork()
        self.bus, self.detector = network.bus(), network.bus(service="contour_detector")
        self._writers = {}
        self.answers, self.chosen = asyncio.Queue(), []
        monkeypatch.setattr(visits, "_line", self.answers.get)
        self.detector.serve(OUTLINE_SELECT, self._select)

    async def _select(self, wanted):
        self.chosen.append(wanted)
        return OutlineSelection(index=0, label="Object_0")

    async def put(self, topic, stamp, value):
        """Publish an array, the pixels of a contour, or the x of an outline, with a stamp."""
        header = m.Header(stamp=stamp, frame_id="camera")
        if isinstance(value, np.ndarray):
            message = array_to_image(value, "bgr8" if value.ndim == 3 else "32FC1", header)
        elif isinstance(value, list):
            found = [Contour(index=0, label="Object_0", pixels=value)] if value else []
            message = Contours(header=header, width=16, height=12, contours=found, selected=0 if value else -1)
        else:
            poses = [m.Pose(position=m.Vector3(x=value, y=y, z=1.0)) for y in (0.0, 0.1, 0.2)]
            message = OutlinePoints(header=header, poses=poses, object="Object_0")
        if topic not in self._writers:
            self._writers[topic] = self.detector.writer(topic)
        self._writers[topic].put(message)
        await turns()


@pytest.fixture
async def cell(monkeypatch):
    return Cell(monkeypatch)


@pytest.mark.parametrize("path_is", ["first", "last"])
async def test_stored_stages_belong_to_the_image_of_the_path(cell, tmp_path, path_is):
    """Messages of three services about one image arrive in any order."""
    storing = asyncio.create_task(visits.store_stages(cell.bus, tmp_path, None))
    await turns()
    for stamp in (1, 2):
        await cell.put(DEPTH_CAMERA_DEPTH, stamp, np.full((12, 16), 0.5, np.float32))
        await cell.put(DEPTH_CAMERA_IMAGE, stamp, np.zeros((12, 16, 3), np.uint8))
    if path_is == "first":
        await cell.put(topics.CONTOUR_PATH, 2, 0.5)
    for stamp, pixels, x in ((2, RIGHT, 0.5), (3, WRONG, 0.9)):
        await cell.put(topics.CONTOURS, stamp, pixels)
        await cell.put(topics.CONTOUR_POINTS, stamp, x)
    if path_is == "last":
        await cell.put(topics.CONTOUR_PATH, 2, 0.5)
    assert (await storing).startswith("Object_0, 3 points")
    assert stage_files.read_pixels(tmp_path / stage_files.PIXELS).tolist() == [list(each) for each in RIGHT]
    assert stage_files.read_coordinates(tmp_path / stage_files.COORDINATES)[:, 0].tolist() == [0.5] * 3


async def test_operator_sees_the_image_of_the_requested_contours(cell, tmp_path):
    """An image of earlier contours comes first, and more arrive before the answer."""
    await cell.detector.ready()
    asking = asyncio.create_task(visits.ask_operator(cell.bus, tmp_path))
    await turns()
    for stamp, pixels in ((1, []), (2, RIGHT), (3, WRONG)):
        await cell.put(topics.CONTOURS, stamp, pixels)
        await cell.put(topics.CONTOUR_IMAGE, stamp, np.full((12, 16, 3), 50 * stamp, np.uint8))
    cell.answers.put_nowait("0")
    async with asyncio.timeout(60):
        await asking
    shown = cv2.imread(str(tmp_path / "test_contours.png"))
    middles = {100: (5 / 3, 4 / 3), 150: (23 / 3, 22 / 3)}
    assert cell.chosen[0].at == pytest.approx(middles[int(shown[0, 0, 0])])


async def test_selection_with_lost_answer_is_repeated_and_an_unanswered_one_reported(
    cell, tmp_path, monkeypatch, capsys
):
    class LosingClient:
        async def call(self, wanted):
            selection = await cell._select(wanted)
            if len(cell.chosen) <= visits.TRIES + 1:
                raise RequestLost(OUTLINE_SELECT.key)
            return selection

        async def wait_available(self, _timeout):
            raise NoResponder(OUTLINE_SELECT.key)

    monkeypatch.setattr(cell.bus, "client", lambda _topic: LosingClient())
    asking = asyncio.create_task(visits.ask_operator(cell.bus, tmp_path))
    await turns()
    await cell.put(topics.CONTOURS, 1, RIGHT)
    await cell.put(topics.CONTOUR_IMAGE, 1, np.zeros((12, 16, 3), np.uint8))
    for _ in range(2):
        cell.answers.put_nowait("0")
    async with asyncio.timeout(60):
        await asking
    assert len(cell.chosen) == visits.TRIES + 2
    output = capsys.readouterr().out
    assert output.count("outline which one?") == 2 and output.count("may have been carried out") == 1
    assert output.endswith("Object_0 is chosen\n")
