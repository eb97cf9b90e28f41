"""From ground truth to path: camera, contours, world points and path, on an in-process network."""

import asyncio
from contextlib import AsyncExitStack

import numpy as np
import pytest

from applications.outlining.top_face import TopFace
from applications.outlining.topics import CONTOUR_PATH, CONTOUR_POINTS, CONTOURS, OUTLINE_SELECT, OutlineSelect
from common import topics
from common.config import (
    CameraConfig,
    ObjectConfig,
    RobotConfig,
    Run,
    Surroundings,
    World,
    check,
    config_root,
    find_file,
    read_robot,
    read_yaml,
)
from common.errors import ConfigError, RemoteError
from common.messages import Header, JointState, TFMessage, Vector3, WorldEdit, WorldObjects
from common.perception.image import array_to_image, image_to_array
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.transforms import rpy_to_matrix, transform
from common.sim.kinematic import KinematicWorld
from common.sim.objects import world_object
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services import contour_detector, depth_camera, duplicate_remover, pixel_to_world
from services.robot_state_publisher import stamped

ROBOT = check(RobotConfig, read_robot(find_file("robots", "ur5")))
W5 = check(World, read_yaml(config_root() / "worlds" / "w5.yaml"))
AROUND = Surroundings.model_validate({f: getattr(W5, f) for f in Surroundings.model_fields})
CAMERA = depth_camera.Config(world=AROUND, robot=ROBOT, run=Run(cell="test"), rate=30, max_rate=30)
DETECTOR, WORLD, REMOVER = contour_detector.Config(), pixel_to_world.Config(), duplicate_remover.Config()


class Cell:
    """The services, with the readers and clients of the test."""

    def __init__(self):
        self.net = LocalNetwork()
        self.bus = self.net.bus()
        self.truth, self.joints = self.bus.writer(topics.SCENE_OBJECTS), self.bus.writer(topics.JOINT_STATES)
        self.static = self.bus.writer(topics.TF_STATIC)
        self.contours, self.points = self.bus.reader(CONTOURS), self.bus.reader(CONTOUR_POINTS)
        self.paths, self.select = self.bus.reader(CONTOUR_PATH), self.bus.client(OUTLINE_SELECT)

    def say(self, objects):
        camera: CameraConfig = AROUND.camera
        T = transform(rpy_to_matrix(*camera.rpy), camera.position)
        self.static.put(TFMessage(transforms=[stamped("world", camera.frame, T, 0)]))
        self.joints.put(JointState(header=Header(), name=ROBOT.joints, position=ROBOT.named_poses["home"]))
        self.truth.put(WorldObjects(objects=[world_object(thing) for thing in objects]))


async def until(reader, wanted):
    async with asyncio.timeout(20):
        while not wanted(message := await reader.next()):
            pass
        return message


def middle(points):
    return np.mean([(p.position.x, p.position.y, p.position.z) for p in points.poses], axis=0)


async def running(stack, cell, *, detector=DETECTOR, world=WORLD, camera=True):
    services = [(contour_detector, detector), (pixel_to_world, world), (duplicate_remover, REMOVER)]
    for module, config in ([(depth_camera, CAMERA)] if camera else []) + services:
        name = module.__name__.rpartition(".")[2]
        await stack.enter_async_context(running_service(cell.net, module.run, config, name=name))


async def test_largest_object_becomes_the_path():
    async with AsyncExitStack() as stack:
        cell = Cell()
        await running(stack, cell)
        cell.say(W5.objects)
        points = await until(cell.points, lambda p: bool(p.poses))
        path = await until(cell.paths, lambda p: bool(p.poses))
        np.testing.assert_allclose(middle(points), (0.46, -0.12, 1.05), atol=1e-3)
        assert points.invalid_depth == 0 and points.header.frame_id == "world"
        assert 4 <= len(path.poses) < len(points.poses) / 4
        assert path.object == points.object


async def test_moved_object_is_outlined_at_its_new_position():
    world = KinematicWorld(W5)
    async with AsyncExitStack() as stack:
        cell = Cell()
        await running(stack, cell)
        cell.say(W5.objects)
        await until(cell.paths, lambda p: bool(p.poses))
        world.edit(WorldEdit(op="move", id="green_box", position=Vector3(x=0.5, y=-0.15)), 0.0)
        cell.truth.put(world.objects(Header()))
        moved = await until(cell.points, lambda p: bool(p.poses) and abs(middle(p)[0] - 0.46) > 0.02)
        np.testing.assert_allclose(middle(moved), (0.5, -0.15, 1.05), atol=1e-3)
        path = await until(cell.paths, lambda p: p.header.stamp >= moved.header.stamp)
        corners = np.array([(p.position.x, p.position.y) for p in path.poses])
        np.testing.assert_allclose((corners.min(axis=0) + corners.max(axis=0)) / 2, (0.5, -0.15), atol=1e-3)


async def test_object_selected_by_color_stays_selected():
    async with AsyncExitStack() as stack:
        cell = Cell()
        await running(stack, cell, detector=DETECTOR.model_copy(update={"select": "none"}))
        cell.say(W5.objects)
        none = await until(cell.points, lambda p: bool(p.message))
        assert "choices: 0 (Object_0" in none.message and not none.poses
        answer = await cell.select.call(OutlineSelect(rule="colour", colour="red"))
        points = await until(cell.points, lambda p: p.object == answer.label)
        np.testing.assert_allclose(middle(points), (0.52, 0.02, 1.08), atol=1e-3)
        later = await until(cell.points, lambda p: p.header.stamp > points.header.stamp)
        np.testing.assert_allclose(middle(later), (0.52, 0.02, 1.08), atol=1e-3)


async def test_selection_of_a_missing_object_is_rejected_with_the_choices():
    async with AsyncExitStack() as stack:
        cell = Cell()
        await running(stack, cell)
        with pytest.raises(RemoteError, match="no picture"):
            await cell.select.call(OutlineSelect())
        cell.say(W5.objects)
        await until(cell.contours, lambda c: c.selected >= 0)
        with pytest.raises(RemoteError, match=r"no contour 7; choices: 0 \(Object_0, .*green"):
            await cell.select.call(OutlineSelect(rule="index", index=7))
        with pytest.raises(RemoteError, match=r"no yellow contour; choices: .*red"):
            await cell.select.call(OutlineSelect(rule="colour", colour="yellow"))


async def test_missing_path_has_a_reason():
    async with AsyncExitStack() as stack:
        cell = Cell()
        await running(stack, cell)
        cell.say([])
        path = await until(cell.paths, lambda p: bool(p.message))
        assert path.message == "the picture has no contour" and not path.poses
        cell.say([ObjectConfig(id="edge", shape="box", x=0.5, y=0.25, z=1.0, size=(0.06, 0.06), height=0.05)])
        path = await until(cell.paths, lambda p: "border" in p.message)
        assert path.message.startswith("every contour touches the border") and not path.poses


async def test_image_depth_and_points_share_a_stamp_and_points_need_a_subscriber():
    async with AsyncExitStack() as stack:
        cell = Cell()
        readers = [cell.bus.reader(t) for t in (
            topics.DEPTH_CAMERA_IMAGE, topics.DEPTH_CAMERA_DEPTH, topics.DEPTH_CAMERA_POINTS)]
        await stack.enter_async_context(running_service(cell.net, depth_camera.run, CAMERA, name="depth_camera"))
        cell.say(W5.objects)
        stamps = [(await until(reader, lambda _: True)).header.stamp for reader in readers]
        assert len(set(stamps)) == 1
        cloud = np.frombuffer(readers[2].latest.data, "<f4").reshape(768, 1024, 4)
        depth = image_to_array(readers[1].latest)
        np.testing.assert_array_equal(cloud[..., 2], depth)
        assert np.nanmin(depth) == pytest.approx(2.75 - 1.08) and np.isnan(depth).any()


async def test_mismatched_depth_is_reported_in_one_line():
    async with AsyncExitStack() as stack:
        cell = Cell()
        depths, infos = cell.bus.writer(topics.DEPTH_CAMERA_DEPTH), cell.bus.writer(topics.DEPTH_CAMERA_INFO)
        images = cell.bus.writer(topics.DEPTH_CAMERA_IMAGE)
        await running(stack, cell, camera=False)
        cell.say([])
        header = Header(stamp=5, frame_id=AROUND.camera.frame)
        infos.put(Pinhole.from_config(AROUND.camera).info(header))
        picture = np.zeros((768, 1024, 3), np.uint8)
        picture[300:400, 400:500] = (0, 255, 255)
        nothing = np.full((768, 1024), np.nan, np.float32)
        for stamp, depth, said in ((5, nothing[::2], "the depth image is 1024x384, but the color image is 1024x768"),
                                   (6, nothing, "the depth image has no valid depth at all")):
            header = Header(stamp=stamp, frame_id=AROUND.camera.frame)
            depths.put(array_to_image(np.ascontiguousarray(depth), "32FC1", header))
            images.put(array_to_image(picture, "bgr8", header))
            path = await until(cell.paths, lambda p, stamp=stamp: p.header.stamp == stamp)
            assert said in path.message and path.message.startswith("Object_0: ") and not path.poses


async def test_too_long_outline_is_reported_and_not_sent(monkeypatch):
    long = TopFace(np.zeros((20_001, 3)), 1.0, 0.9, 0, True)
    monkeypatch.setattr(pixel_to_world, "top_face", lambda *_, **__: long)
    async with AsyncExitStack() as stack:
        cell = Cell()
        await running(stack, cell)
        cell.say(W5.objects)
        path = await until(cell.paths, lambda p: bool(p.message))
        assert "20001 points are more than an outline has room for" in path.message and not path.poses


async def test_only_the_camera_reads_the_ground_truth():
    assert topics.SCENE_OBJECTS in (await wiring(depth_camera.run, CAMERA)).reads
    for module, config in ((contour_detector, DETECTOR), (pixel_to_world, WORLD), (duplicate_remover, REMOVER)):
        assert topics.SCENE_OBJECTS not in (await wiring(module.run, config)).reads


@pytest.mark.parametrize("module, config, owned", [
    (depth_camera, CAMERA, {"depth_camera/image_raw", "depth_camera/depth/image_raw", "depth_camera/points",
                            "depth_camera/camera_info"}),
    (contour_detector, DETECTOR, {"contours", "contour_image", "outline/select"}),
    (pixel_to_world, WORLD, {"contour_points"}), (duplicate_remover, REMOVER, {"contour_path"})])
async def test_each_stage_writes_the_input_of_the_next(module, config, owned):
    assert {topic.key for topic in (await wiring(module.run, config)).owns} == owned


def test_invalid_initial_selection_is_a_config_error():
    with pytest.raises(ConfigError, match=r"services.contour_detector.select.*'bleu'.*choices: none, auto"):
        contour_detector.initial_choice("bleu")

