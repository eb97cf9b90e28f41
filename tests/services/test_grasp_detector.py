"""The grasp detector on a network: objects and grasps at home, foreign bodies always; unusable images are skipped."""

from __future__ import annotations

from collections.abc import AsyncIterator

import numpy as np
import pytest
from pydantic import ValidationError

from applications.sorting.topics import HEAP, HEAP_IMAGE
from common import topics
from common.config import Surroundings
from common.config.loading import load_robot
from common.errors import ConfigError
from common.messages import GripperState, Header
from common.perception.image import image_to_array
from services import grasp_detector
from tests.applications.sorting.scenes import BLUE, GREEN, RED, box, tray_world, view_of
from tests.services.fake_cell import FakeCell, settle, until

FRAME = "depth_camera_optical_frame"
ROBOT = load_robot("panda")
WORLD = Surroundings.model_validate({name: getattr(tray_world(), name) for name in Surroundings.model_fields})
SECOND = 10**9  # [ns]
MESHES = (box(0.53, 0.05, (0.04, 0.06, 0.05), RED, 0.3), box(0.60, -0.08, (0.05, 0.05, 0.03), BLUE))
HAND = box(0.60, 0.10, (0.08, 0.08, 0.10), (0.9, 0.7, 0.6), z=0.25)


class SortingCell(FakeCell):
    """A depth camera above the tray, and an arm that is at home or elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.heaps = self.reader(HEAP)
        self.calibrate(view_of([])[2], FRAME, topics.DEPTH_CAMERA_INFO)
        self.put(topics.GRIPPER_STATE, GripperState(header=Header(), width=0.08))

    async def arm(self, stamp: int, *, away: float = 0.0) -> None:
        """Publish joint positions before and after an image, and let the service read each."""
        q = [value + away for value in ROBOT.named_poses["home"]]
        for at in (stamp - SECOND // 50, stamp + SECOND // 50):
            self.put_joints([*ROBOT.joints, *ROBOT.gripper.joints], [*q, 0.04, 0.04], at)
            await settle()

    def image(self, meshes, stamp: int, *, depth_first: bool = True, encoding: str = "32FC1") -> None:
        depth, color, _ = view_of(meshes, stamp % 97)
        if encoding == "16UC1":
            depth = np.rint(np.nan_to_num(1000 * depth)).astype(np.uint16)
        parts = [(topics.DEPTH_CAMERA_DEPTH, depth, encoding), (topics.DEPTH_CAMERA_IMAGE, color, "bgr8")]
        for topic, pixels, kind in parts if depth_first else parts[::-1]:
            self.put_image(topic, pixels, kind, stamp, FRAME)


@pytest.fixture
async def cell() -> AsyncIterator[SortingCell]:
    fake = SortingCell()
    async with fake.running(grasp_detector, grasp_detector.Config(robot=ROBOT, world=WORLD)):
        yield fake


@pytest.mark.parametrize(("depth_first", "encoding"), [(True, "32FC1"), (False, "32FC1"), (True, "16UC1")])
async def test_objects_have_proved_grasps_at_their_own_places(cell, depth_first, encoding) -> None:
    await cell.arm(SECOND)
    cell.image(MESHES, SECOND, depth_first=depth_first, encoding=encoding)
    heap = await until(cell.heaps)
    assert (heap.header.stamp, heap.at_home, heap.foreign) == (SECOND, True, [])
    assert {seen.color_name for seen in heap.objects} == {"red", "blue"}
    assert 0 < heap.seconds < 30 and 0 <= heap.hidden < 0.05 and heap.scorer == "geometric"
    places = {seen.id: seen.center for seen in heap.objects}
    proved = [grasp for grasp in heap.grasps if grasp.proved]
    assert {grasp.object for grasp in proved} | {each.object for each in heap.left} == set(places)
    assert proved
    for grasp in proved:
        assert len(grasp.q) == len(grasp.q_approach) == len(ROBOT.joints)
        at, center = grasp.pose.position, places[grasp.object]
        assert np.hypot(at.x - center.x, at.y - center.y) < 0.03
        assert grasp.approach.position.z > at.z


async def test_image_shows_outlines_where_the_objects_are(cell) -> None:
    shown = cell.reader(HEAP_IMAGE)
    await cell.arm(SECOND)
    cell.image([box(0.62, 0.12, (0.05, 0.05, 0.05), GREEN)], SECOND)
    picture = image_to_array(await until(shown)).astype(int)
    before = view_of([box(0.62, 0.12, (0.05, 0.05, 0.05), GREEN)], SECOND % 97)[1].astype(int)
    u, v = view_of([])[2].project((0.62, 0.12, 0.055))
    changed = np.abs(picture - before).max(axis=2) > 30
    rows, columns = np.nonzero(changed[20:, :])
    near = (np.abs(rows + 20 - v) < 60) & (np.abs(columns - u) < 90)
    assert near.mean() > 0.9, "drawings are about the object"


async def test_away_from_home_only_foreign_bodies_are_published(cell) -> None:
    await cell.arm(SECOND)
    cell.image(MESHES, SECOND)
    assert (await until(cell.heaps)).at_home
    for number in (2, 3):
        await cell.arm(number * SECOND, away=0.2)
        cell.image([*MESHES, HAND], number * SECOND)
        heap = await until(cell.heaps)
        assert not heap.at_home and heap.objects == [] and heap.grasps == []
    assert len(heap.foreign) == 1


async def test_unusable_images_do_not_end_the_service(cell) -> None:
    await cell.arm(SECOND)
    depth, color, _ = view_of(MESHES)
    cell.put_image(topics.DEPTH_CAMERA_DEPTH, depth[:100], "32FC1", SECOND, FRAME)  # wrong size
    cell.put_image(topics.DEPTH_CAMERA_IMAGE, color, "bgr8", SECOND, FRAME)
    cell.put_image(topics.DEPTH_CAMERA_IMAGE, color, "bgr8", SECOND + 1, FRAME)  # without depth
    cell.put_image(topics.DEPTH_CAMERA_DEPTH, np.full_like(depth, np.nan), "32FC1", SECOND + 2, FRAME)
    cell.put_image(topics.DEPTH_CAMERA_IMAGE, color, "bgr8", SECOND + 2, FRAME)  # without any measurement
    await cell.arm(2 * SECOND)
    cell.image(MESHES, 2 * SECOND)
    assert len((await until(cell.heaps, lambda heap: heap.header.stamp == 2 * SECOND)).objects) == 2


async def test_unknown_tray_is_refused_with_the_choices() -> None:
    fake = SortingCell()
    with pytest.raises(ConfigError, match=r"services.grasp_detector.tray.*tray, left, right"):
        async with fake.running(grasp_detector, grasp_detector.Config(robot=ROBOT, world=WORLD, tray="bin")):
            await settle()


@pytest.mark.parametrize(("parameters", "text"), [
    ({"views": ["left", "left"]}, "'left' is listed twice"),
    ({"network": "mine.onnx"}, "network 'mine.onnx' has no effect with scorer 'geometric'; choose learned"),
])
def test_parameters_without_an_effect_are_refused(parameters, text) -> None:
    with pytest.raises(ValidationError, match=text):
        grasp_detector.Config(robot=ROBOT, world=WORLD, **parameters)
