"""A camera on the hand: the simulated one looks from where the joints have it, and readers know that pose."""

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
from common.process import camera_reader
from common.process.camera_reader import CameraReader
from common.robot.model import RobotModel
from common.sim.rendering import Renderer
from services import depth_camera, robot_state_publisher
from tests.common.sim.spheres import spheres
from tests.harness import running_with
from tests.services.fake_cell import PATIENCE, FakeCell, settle, until

SMALL = {"width": 64, "height": 48, "fx": 34, "fy": 34, "cx": 32, "cy": 24}
CELL = load_cell(str(Path(__file__).parents[1] / "data" / "hand_camera.yaml"),
                 [f"world.camera.{field}={value}" for field, value in SMALL.items()])
AROUND = CELL.section(Surroundings)
assert isinstance(AROUND, Surroundings)
ROBOT = RobotModel.load(CELL.robot)
HOME = ROBOT.named("home")
MOUNTED = MountedCamera(AROUND.camera, ROBOT)
PUBLISHER = service_config(CELL, "robot_state_publisher", robot_state_publisher.Config)
MS = 1_000_000


async def test_depth_of_a_mounted_camera_lies_on_the_table_at_any_pose(monkeypatch) -> None:
    monkeypatch.setattr(camera_reader, "TF_TIMEOUT", PATIENCE)
    cell, stamp, q = FakeCell(), 0, HOME
    depths = cell.reader(topics.DEPTH_CAMERA_DEPTH)
    cell.put(topics.SCENE_OBJECTS, WorldObjects())
    camera = CameraReader(cell.bus, AROUND, topics.DEPTH_CAMERA_INFO)
    config = service_config(CELL, "depth_camera", depth_camera.Config)
    config = config.model_copy(update={"rate": 20.0, "max_rate": 20.0})

    async def move() -> None:
        nonlocal stamp
        while True:
            stamp += 20 * MS
            cell.put_joints(ROBOT.joint_names, q, stamp)
            await asyncio.sleep(0.01)

    places = []
    async with (running_with(move(), camera.follow()), cell.running(depth_camera, config),
                cell.running(robot_state_publisher, PUBLISHER)):
        for q in (HOME, HOME + np.array([0.15, 0.1, 0.0, 0.2, 0.1, 0.1, 0.3])):
            since = stamp
            image = await until(depths, lambda image, since=since: image.header.stamp > since)
            found, depth = await camera.of(image.header), depth_of(image)
            np.testing.assert_allclose(found.T_world_optical, MOUNTED.at(q).T_world_optical, atol=1e-6)
            rows, columns = np.nonzero(np.isfinite(depth))
            rays = np.stack([(columns - 32) / 34, (rows - 24) / 34, np.ones(len(rows))], axis=1)
            world = (rays * depth[rows, columns, None]) @ found.T_world_optical[:3, :3].T + found.position
            on_table = np.abs(world[:, 2]) < 1e-3
            assert on_table.mean() > 0.5, "the rest is box, fingers and arm"
            places.append(world[on_table].mean(axis=0))
    assert np.abs(places[0] - places[1]).max() > 0.02, "it looked elsewhere"


async def test_image_waits_for_its_transform_and_is_skipped_without_one(monkeypatch) -> None:
    cell = FakeCell()
    monkeypatch.setattr(camera_reader, "TF_TIMEOUT", PATIENCE)
    moving, camera = cell.reader(topics.TF), CameraReader(cell.bus, AROUND)
    image = Header(stamp=1030 * MS, frame_id="camera_optical_frame")
    cell.put(topics.CAMERA_INFO, CameraInfo(header=image, width=64, height=48, d=[0.0] * 5,
                                            k=[34.0, 0.0, 32.0, 0.0, 34.0, 24.0, 0.0, 0.0, 1.0]))
    async with running_with(camera.follow()), cell.running(robot_state_publisher, PUBLISHER):
        cell.put_joints(ROBOT.joint_names, HOME, 1000 * MS)
        await until(moving)
        waiting = asyncio.create_task(camera.of(image))
        await settle()
        assert not waiting.done()
        cell.put_joints(ROBOT.joint_names, HOME + 0.02, 1060 * MS)
        found = await waiting
        np.testing.assert_allclose(found.T_world_optical, MOUNTED.at(HOME + 0.01).T_world_optical, atol=1e-4)
        monkeypatch.setattr(camera_reader, "TF_TIMEOUT", 0.05)
        with pytest.raises(FrameError, match="tf has no pose of 'panda_link7' at the time of the image yet") as caught:
            await camera.of(image.model_copy(update={"stamp": 9000 * MS}))
        assert caught.value.kind == "early"


def test_moved_camera_renders_like_a_new_one() -> None:
    things, there = spheres([(0.4, -0.1, 0.03), (0.5, 0.05, 0.03)]).objects, MOUNTED.at(HOME + 0.1)
    joints = JointState(header=Header(), name=ROBOT.joint_names, position=HOME.tolist())
    for robots in ([], [ROBOT]):
        moved = Renderer(AROUND, *robots, plain=not robots, camera=MOUNTED.at())
        before = moved.render(things, joints).colour.copy()
        moved.move_camera(there)
        fresh = Renderer(AROUND, *robots, plain=not robots, camera=there)
        seen, expected = moved.render(things, joints), fresh.render(things, joints)
        np.testing.assert_array_equal(seen.colour, expected.colour)
        np.testing.assert_array_equal(seen.depth, expected.depth)
        assert not np.array_equal(seen.colour, before)
