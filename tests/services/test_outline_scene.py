from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from applications.outlining.contours import ContourOptions, find_contours
from applications.outlining.topics import CONTOURS, Contour, Contours
from common import messages as m
from common import topics
from common.clock import Clock
from common.config import Surroundings, load_cell, service_config
from common.perception.camera_input import FrameError
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.transforms import matrix_to_pose
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from services import outline_scene, pixel_to_world

CELL = load_cell("ur5")
CONFIG = service_config(CELL, "outline_scene", outline_scene.Config)
AROUND = CELL.section(Surroundings)
assert isinstance(AROUND, Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
HOME = CELL.robot.named_poses["home"]
TOP, BASE = 1.65, 1.75  # depths [m] of a cube's top and of its support


def cube_depth() -> NDArray[np.float32]:
    """Of a cube in the middle of the picture, 200 pixels wide."""
    depth = np.full((CAMERA.height, CAMERA.width), BASE, np.float32)
    depth[284:485, 412:613] = TOP
    return depth


def cube_contours(stamp: int = 0) -> Contours:
    side = np.arange(201)
    pixels = [*((412 + k, 284) for k in side), *((612, 284 + k) for k in side[1:]),
              *((612 - k, 484) for k in side[1:]), *((412, 484 - k) for k in side[1:-1])]
    cube = Contour.model_validate({"index": 0, "label": "Object_0", "area": 4e4, "pixels": [
        (float(u), float(v)) for u, v in pixels]})
    return Contours(header=m.Header(stamp=stamp), width=CAMERA.width, height=CAMERA.height, contours=[cube], selected=0)


class Neighbours:
    """Says what the camera, the detector and the arm would say."""

    def __init__(self, net: LocalNetwork) -> None:
        self.bus: Bus = net.bus("tester", cell="test", clock=Clock())
        frame = AROUND.camera.frame
        self.depths, self.contours = self.bus.writer(topics.DEPTH_CAMERA_DEPTH), self.bus.writer(CONTOURS)
        self.joints = self.bus.writer(topics.JOINT_STATES)
        self.scenes = self.bus.reader(topics.PLANNING_SCENE)
        self.bus.writer(topics.DEPTH_CAMERA_INFO).put(CAMERA.info(m.Header(frame_id=frame)))
        camera = m.TransformStamped(header=m.Header(frame_id="world"), child_frame_id=frame,
                                    transform=matrix_to_pose(CAMERA.T_world_optical))
        self.bus.writer(topics.TF_STATIC).put(m.TFMessage(transforms=[camera]))

    def arm(self, q: list[float], stamp: int) -> None:
        self.joints.put(m.JointState(header=m.Header(stamp=stamp), name=CELL.robot.joints, position=q))

    def see(self, stamp: int) -> None:
        self.depths.put(array_to_image(cube_depth(), "32FC1", m.Header(stamp=stamp, frame_id=AROUND.camera.frame)))
        self.contours.put(cube_contours(stamp))

    async def scene(self) -> m.PlanningScene:
        async with asyncio.timeout(30):
            return await self.scenes.next()

    async def seen(self, since: int) -> m.PlanningScene:
        """The scene of one of the pictures that are taken from a stamp on."""
        for stamp in range(since, since + 1000):  # the service may hear of the arm after the first ones
            self.see(stamp)
            try:
                async with asyncio.timeout(0.1):
                    return await self.scenes.next()
            except TimeoutError:
                continue
        raise AssertionError("no picture became a scene")


async def test_scene_starts_with_fixtures_and_adds_solids_seen_from_home() -> None:
    net = LocalNetwork()
    async with running_service(net, outline_scene.run, CONFIG, name="outline_scene"):
        around = Neighbours(net)
        first = await around.scene()
        assert [o.id for o in first.objects] == ["robot_base", "target_base"]
        around.arm(HOME, 1)
        seen = await around.seen(since=5)
        cube = seen.objects[-1]
        assert (cube.id, cube.shape) == ("Object_0", "prism")
        at, half = cube.pose.position, 200 * TOP / CAMERA.fx / 2
        assert np.allclose((at.x, at.y, at.z), (0.5, 0.0, 1.05), atol=0.002)
        assert np.allclose(np.abs(np.array(cube.outline)).max(axis=0), half, atol=0.001)


def test_encoding_identifies_depth_in_millimeters() -> None:
    image = array_to_image(np.rint(1000 * cube_depth()).astype(np.uint16), "16UC1")
    cube = outline_scene.seen(cube_contours(), image, CAMERA, AROUND).objects[-1]
    assert cube.id == "Object_0" and abs(cube.pose.position.z - 1.05) < 0.002


def test_image_without_depth_is_not_an_empty_scene() -> None:
    image = array_to_image(np.full_like(cube_depth(), np.nan), "32FC1")
    with pytest.raises(FrameError, match="no valid depth at all"):
        outline_scene.seen(cube_contours(), image, CAMERA, AROUND)


def test_depth_of_another_size_is_dropped() -> None:
    image = array_to_image(cube_depth()[::2, ::2], "32FC1")
    with pytest.raises(FrameError, match=f"512x384, but the color image is {CAMERA.width}x{CAMERA.height}"):
        outline_scene.seen(cube_contours(), image, CAMERA, AROUND)


def test_heavily_overlapping_contours_are_dropped() -> None:
    found = cube_contours()
    around = [(-1e12, -1e12), (1e12, -1e12), (1e12, 1e12), (-1e12, 1e12)]
    many = [Contour.model_construct(index=i, label=f"Object_{i}", pixels=around) for i in range(1000)]
    image = array_to_image(cube_depth(), "32FC1")
    with pytest.raises(FrameError, match="its 1000 contours cover it more than 20 times"):
        outline_scene.seen(found.model_copy(update={"contours": many}), image, CAMERA, AROUND)


@pytest.mark.parametrize("change", [{"fx": 1e-6}, {"cy": 1e12}])
def test_solid_out_of_message_range_is_dropped(change: dict[str, float]) -> None:
    image = array_to_image(cube_depth(), "32FC1")
    with pytest.raises(FrameError, match=r"more than 1e\+07 m away"):
        outline_scene.seen(cube_contours(), image, replace(CAMERA, **change), AROUND)


@pytest.mark.parametrize("change", [{"fx": 1e-6}, {"cy": 1e12}])
def test_outline_out_of_message_range_is_rejected(change: dict[str, float]) -> None:
    image = array_to_image(cube_depth(), "32FC1")
    with pytest.raises(FrameError, match=r"more than 1e\+07 m away"):
        pixel_to_world.outline(cube_contours(), image, replace(CAMERA, **change), pixel_to_world.Config())


async def test_image_with_the_arm_is_dropped() -> None:
    net = LocalNetwork()
    async with running_service(net, outline_scene.run, CONFIG, name="outline_scene"):
        around = Neighbours(net)
        await around.scene()
        around.arm([0.0] * 6, 1)
        around.see(5)
        around.arm(HOME, 10)
        assert (await around.seen(since=15)).header.stamp >= 15


async def test_future_image_does_not_block_later_ones() -> None:
    net = LocalNetwork()
    async with running_service(net, outline_scene.run, CONFIG, name="outline_scene"):
        around = Neighbours(net)
        await around.scene()
        around.arm(HOME, 1)
        assert (await around.seen(since=2**63 - 1000)).header.stamp >= 2**63 - 1000
        assert (await around.seen(since=5)).header.stamp < 2000


async def test_image_with_too_many_objects_is_dropped() -> None:
    net = LocalNetwork()
    async with running_service(net, outline_scene.run, CONFIG, name="outline_scene"):
        around = Neighbours(net)
        await around.scene()
        around.arm(HOME, 1)
        await around.seen(since=5)
        noise = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
        for row in range(5):
            for column in range(5):
                noise[20 + row:-20:33, 20 + column:-20:33] = (0, 0, 255)
        spots = find_contours(noise, ContourOptions())
        depth = np.full((CAMERA.height, CAMERA.width), BASE, np.float32)
        crowded = 10_000
        header = m.Header(stamp=crowded, frame_id=AROUND.camera.frame)
        around.depths.put(array_to_image(depth, "32FC1", header))
        around.contours.put(Contours(header=header, width=CAMERA.width, height=CAMERA.height, contours=spots))
        for _ in range(50):  # until it is processed: only the newest message counts
            await asyncio.sleep(0)
        since = crowded + 1
        while (scene := await around.seen(since)).header.stamp < crowded:  # of the first pictures, on a busy machine
            since += 1000
        assert scene.header.stamp > crowded
