"""From ground truth to path: camera, contours, world points and path, on an in-process network."""

from contextlib import AsyncExitStack, asynccontextmanager

import numpy as np
import pytest

from applications.outlining.stage_files import write_points
from applications.outlining.top_face import TopFace
from applications.outlining.topics import (
    CONTOUR_PATH,
    CONTOUR_POINTS,
    CONTOURS,
    OUTLINE_SELECT,
    OutlinePoints,
    OutlineSelect,
)
from common import topics
from common.config import ObjectConfig, Run, Surroundings, World, check, config_root, load_cell, read_yaml
from common.errors import ConfigError, RemoteError
from common.messages import Header, Vector3, WorldEdit, WorldObjects
from common.perception.image import image_to_array
from common.perception.pinhole import Pinhole
from common.sim.kinematic import KinematicWorld
from common.sim.objects import world_object
from services import contour_detector, depth_camera, duplicate_remover, pixel_to_world
from tests.services.fake_cell import FakeCell, until

ROBOT = load_cell("ur5").robot
W5 = check(World, read_yaml(config_root() / "worlds" / "w5.yaml"))
AROUND = Surroundings.model_validate({f: getattr(W5, f) for f in Surroundings.model_fields})
CAMERA = depth_camera.Config(world=AROUND, robot=ROBOT, run=Run(cell="test"), rate=30, max_rate=30)
PINHOLE = Pinhole.from_config(AROUND.camera)
TRIANGLE = [(0.5, 0.0, 1.0), (0.6, 0.0, 1.0), (0.5, 0.1, 1.0)]


class Cell(FakeCell):
    """The stages from the images to the path."""

    def __init__(self):
        super().__init__()
        self.contours, self.points = self.reader(CONTOURS), self.reader(CONTOUR_POINTS)
        self.paths, self.select = self.reader(CONTOUR_PATH), self.client(OUTLINE_SELECT)

    def show(self, objects):
        self.calibrate(PINHOLE, AROUND.camera.frame, topics.DEPTH_CAMERA_INFO)
        self.put_joints(ROBOT.joints, ROBOT.named_poses["home"], 0)
        self.put(topics.SCENE_OBJECTS, WorldObjects(objects=[world_object(thing) for thing in objects]))


@asynccontextmanager
async def running(*, camera=True, **detector):
    cell = Cell()
    services = [(contour_detector, contour_detector.Config(**detector)), (pixel_to_world, pixel_to_world.Config()),
                (duplicate_remover, duplicate_remover.Config())]
    async with AsyncExitStack() as stack:
        for module, config in ([(depth_camera, CAMERA)] if camera else []) + services:
            await stack.enter_async_context(cell.running(module, config))
        yield cell


def middle(points):
    return np.mean([(p.position.x, p.position.y, p.position.z) for p in points.poses], axis=0)


async def test_largest_object_becomes_the_path_also_after_it_was_moved():
    world = KinematicWorld(W5)
    async with running() as cell:
        cell.show(W5.objects)
        points = await until(cell.points, lambda p: p.poses)
        path = await until(cell.paths, lambda p: p.poses)
        np.testing.assert_allclose(middle(points), (0.46, -0.12, 1.05), atol=1e-3)
        assert points.invalid_depth == 0 and points.header.frame_id == "world"
        assert 4 <= len(path.poses) < len(points.poses) / 4 and path.object == points.object
        world.edit(WorldEdit(op="move", id="green_box", position=Vector3(x=0.5, y=-0.15)), 0.0)
        cell.put(topics.SCENE_OBJECTS, world.objects(Header()))
        moved = await until(cell.points, lambda p: p.poses and abs(middle(p)[0] - 0.46) > 0.02)
        np.testing.assert_allclose(middle(moved), (0.5, -0.15, 1.05), atol=1e-3)
        path = await until(cell.paths, lambda p: p.header.stamp >= moved.header.stamp)
        corners = np.array([(p.position.x, p.position.y) for p in path.poses])
        np.testing.assert_allclose((corners.min(axis=0) + corners.max(axis=0)) / 2, (0.5, -0.15), atol=1e-3)


async def test_object_selected_by_color_stays_selected_and_missing_ones_are_rejected_with_the_choices():
    async with running(select="none") as cell:
        with pytest.raises(RemoteError, match="no image"):
            await cell.select.call(OutlineSelect())
        cell.show(W5.objects)
        none = await until(cell.points, lambda p: p.message)
        assert "choices: 0 (Object_0" in none.message and not none.poses
        answer = await cell.select.call(OutlineSelect(rule="colour", colour="red"))
        points = await until(cell.points, lambda p: p.object == answer.label)
        later = await until(cell.points, lambda p: p.header.stamp > points.header.stamp)
        for found in (points, later):
            np.testing.assert_allclose(middle(found), (0.52, 0.02, 1.08), atol=1e-3)
        with pytest.raises(RemoteError, match=r"no contour 7; choices: 0 \(Object_0, .*green"):
            await cell.select.call(OutlineSelect(rule="index", index=7))
        with pytest.raises(RemoteError, match=r"no yellow contour; choices: .*red"):
            await cell.select.call(OutlineSelect(rule="colour", colour="yellow"))
    with pytest.raises(ConfigError, match=r"services.contour_detector.select.*'bleu'.*choices: none, auto"):
        contour_detector.initial_choice("bleu")


async def test_missing_path_has_a_reason(monkeypatch):
    async with running() as cell:
        for objects, reason in (
            ([], "the picture has no contour"),
            ([ObjectConfig(id="edge", shape="box", x=0.5, y=0.25, z=1.0, size=(0.06, 0.06), height=0.05)],
             "every contour touches the border"),
        ):
            cell.show(objects)
            path = await until(cell.paths, lambda p, reason=reason: p.message.startswith(reason))
            assert not path.poses
        long = TopFace(np.zeros((20_001, 3)), 1.0, 0.9, 0, True)
        monkeypatch.setattr(pixel_to_world, "top_face", lambda *_, **__: long)
        cell.show(W5.objects)
        path = await until(cell.paths, lambda p: "20001 points are more than an outline has room for" in p.message)
        assert not path.poses


async def test_mismatched_depth_is_reported_in_one_line():
    yellow, no_depth = np.zeros((768, 1024, 3), np.uint8), np.full((768, 1024), np.nan, np.float32)
    yellow[300:400, 400:500] = (0, 255, 255)
    async with running(camera=False) as cell:
        cell.show([])
        for stamp, depth, reason in (
            (5, np.ascontiguousarray(no_depth[::2]), "the depth image is 1024x384, but the color image is 1024x768"),
            (6, no_depth, "the depth image has no valid depth at all"),
        ):
            cell.put_image(topics.DEPTH_CAMERA_DEPTH, depth, "32FC1", stamp, AROUND.camera.frame)
            cell.put_image(topics.DEPTH_CAMERA_IMAGE, yellow, "bgr8", stamp, AROUND.camera.frame)
            path = await until(cell.paths, lambda p, stamp=stamp: p.header.stamp == stamp)
            assert reason in path.message and path.message.startswith("Object_0: ") and not path.poses


async def test_image_depth_and_points_share_a_stamp():
    cell = Cell()
    readers = [cell.reader(topic) for topic in (
        topics.DEPTH_CAMERA_IMAGE, topics.DEPTH_CAMERA_DEPTH, topics.DEPTH_CAMERA_POINTS)]
    async with cell.running(depth_camera, CAMERA):
        cell.show(W5.objects)
        _, depth, cloud = messages = [await until(reader) for reader in readers]
    assert len({message.header.stamp for message in messages}) == 1
    metres = image_to_array(depth)
    np.testing.assert_array_equal(np.frombuffer(cloud.data, "<f4").reshape(768, 1024, 4)[..., 2], metres)
    assert np.nanmin(metres) == pytest.approx(2.75 - 1.08) and np.isnan(metres).any()


@pytest.mark.parametrize(("points", "problem"), [
    (TRIANGLE * 6667, "at most 20000"), ([*TRIANGLE, (5e8, 0.0, 0.0)], "10000000")], ids=["too many", "too far"])
def test_unusable_coordinates_of_a_file_are_rejected_at_the_start(tmp_path, points, problem):
    write_points(file := tmp_path / "a.json", points)
    with pytest.raises(ConfigError, match=problem):
        duplicate_remover.points_of(file)


async def test_coordinates_are_read_from_any_folder_name(tmp_path):
    write_points(file := tmp_path / ("a" * 200) / "b\tc.json", TRIANGLE)
    cell = Cell()
    async with cell.running(duplicate_remover, duplicate_remover.Config(coordinates=str(file))):
        cell.put(CONTOUR_POINTS, OutlinePoints())
        path = await until(cell.paths)
    assert path.given and len(path.poses) == 3 and path.object.endswith(r"a/b\u0009c.json")
