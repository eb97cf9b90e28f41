"""CameraCache on the hand: the simulated one looks from where the joints have it, and readers learn where that was."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from common import topics
from common.config import Surroundings, load_cell, service_config
from common.messages import CameraInfo, Header, JointState, WorldObjects
from common.perception.camera_input import FrameError
from common.perception.depth import depth_of
from common.perception.pinhole import MountedCamera
from common.process.camera_reader import CameraReader
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.sim.rendering import Renderer
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services import depth_camera, robot_state_publisher, vision_detector
from tests.common.sim.spheres import spheres
from tests.harness import running_with

SMALL = {"width": 64, "height": 48, "fx": 34, "fy": 34, "cx": 32, "cy": 24}
CELL = load_cell(str(Path(__file__).parents[1] / "data" / "hand_camera.yaml"),
                 [f"world.camera.{field}={value}" for field, value in SMALL.items()])
AROUND = CELL.section(Surroundings)
assert isinstance(AROUND, Surroundings)
ROBOT = RobotModel.load(CELL.robot)
HOME = ROBOT.named("home")
MS = 1_000_000


def joints(stamp: int, q: np.ndarray) -> JointState:
    return JointState(header=Header(stamp=stamp), name=ROBOT.joint_names, position=q.tolist())


async def test_depth_of_a_mounted_camera_lies_on_the_table_at_any_pose() -> None:
    net = LocalNetwork()
    bus = net.bus()
    arm, depths = bus.writer(topics.JOINT_STATES), bus.reader(topics.DEPTH_CAMERA_DEPTH)
    bus.writer(topics.SCENE_OBJECTS).put(WorldObjects())
    camera = CameraReader(bus, AROUND, topics.DEPTH_CAMERA_INFO)
    config = service_config(CELL, "depth_camera", depth_camera.Config)
    config = config.model_copy(update={"rate": 20.0, "max_rate": 20.0})
    publisher = service_config(CELL, "robot_state_publisher", robot_state_publisher.Config)
    turned = HOME + np.array([0.15, 0.1, 0.0, 0.2, 0.1, 0.1, 0.3])
    stamp, q = 0, HOME

    async def move() -> None:
        nonlocal stamp
        while True:
            stamp += 20 * MS
            arm.put(joints(stamp, q))
            await asyncio.sleep(0.01)

    async with (
        running_with(move()), running_with(camera.follow()),
        running_service(net, depth_camera.run, config, name="depth_camera"),
        running_service(net, robot_state_publisher.run, publisher, name="robot_state_publisher"), asyncio.timeout(60),
    ):
        places = []
        for q in (HOME, turned):
            since = stamp
            image = await depths.next()
            while image.header.stamp <= since:
                image = await depths.next()
            seen, depth = await camera.of(image.header), depth_of(image)
            np.testing.assert_allclose(seen.T_world_optical, MountedCamera(AROUND.camera, ROBOT).at(q).T_world_optical,
                                       atol=1e-6)
            rows, columns = np.nonzero(np.isfinite(depth))
            rays = np.stack([(columns - 32) / 34, (rows - 24) / 34, np.ones(len(rows))], axis=1)
            world = (rays * depth[rows, columns, None]) @ seen.T_world_optical[:3, :3].T + seen.position
            on_table = np.abs(world[:, 2]) < 1e-3  # the rest is box, fingers and arm
            assert on_table.mean() > 0.5, on_table.mean()
            places.append(world[on_table].mean(axis=0))
        assert np.abs(places[0] - places[1]).max() > 0.02  # it looked elsewhere


async def test_image_waits_for_its_transform_and_is_skipped_without_one() -> None:
    net = LocalNetwork()
    bus = net.bus()
    arm, infos = bus.writer(topics.JOINT_STATES), bus.writer(topics.CAMERA_INFO)
    camera = CameraReader(bus, AROUND)
    infos.put(CameraInfo(header=Header(frame_id="camera_optical_frame"), width=64, height=48, d=[0.0] * 5,
                         k=[34.0, 0.0, 32.0, 0.0, 34.0, 24.0, 0.0, 0.0, 1.0]))
    publisher = service_config(CELL, "robot_state_publisher", robot_state_publisher.Config)
    picture = Header(stamp=1030 * MS, frame_id="camera_optical_frame")
    async with (
        running_with(camera.follow()),
        running_service(net, robot_state_publisher.run, publisher, name="robot_state_publisher"), asyncio.timeout(60),
    ):
        moving = bus.reader(topics.TF)
        arm.put(joints(1000 * MS, HOME))
        await moving.next()
        waiting = asyncio.create_task(camera.of(picture))
        await asyncio.sleep(0)
        assert not waiting.done()
        arm.put(joints(1060 * MS, HOME + 0.02))
        found = await waiting
        expected = MountedCamera(AROUND.camera, ROBOT).at(HOME + 0.01)
        np.testing.assert_allclose(found.T_world_optical, expected.T_world_optical, atol=1e-4)
        with pytest.raises(FrameError, match="tf has no pose of 'panda_link7' at the time of the image yet") as refused:
            await camera.of(picture.model_copy(update={"stamp": 9000 * MS}))
        assert refused.value.kind == "early"


async def test_only_cells_with_a_camera_on_the_robot_read_tf() -> None:
    for cell, reads in ((CELL, True), (load_cell("panda"), False)):
        found = await wiring(vision_detector.run, service_config(cell, "vision_detector", vision_detector.Config))
        assert (topics.TF in found.reads) == reads


def test_moved_camera_renders_like_a_new_one() -> None:
    things = spheres([(0.4, -0.1, 0.03), (0.5, 0.05, 0.03)]).objects
    mounted = MountedCamera(AROUND.camera, ROBOT)
    there = mounted.at(HOME + 0.1)
    for robot in (None, ROBOT):
        moved = Renderer(AROUND, robot, plain=robot is None, camera=mounted.at())
        before = moved.render(things, joints(0, HOME)).colour.copy()
        moved.move_camera(there)
        fresh = Renderer(AROUND, robot, plain=robot is None, camera=there)
        seen, expected = moved.render(things, joints(0, HOME)), fresh.render(things, joints(0, HOME))
        np.testing.assert_array_equal(seen.colour, expected.colour)
        np.testing.assert_array_equal(seen.depth, expected.depth)
        assert not np.array_equal(seen.colour, before)
