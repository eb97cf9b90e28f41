from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from applications.outlining.contours import ContourOptions, find_contours
from applications.outlining.topics import CONTOURS, Contour, Contours
from common import messages as m
from common import topics
from common.config import Surroundings, load_cell, service_config
from common.perception.camera_input import FrameError
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole
from services import outline_scene, pixel_to_world
from tests.services.fake_cell import FakeCell, settle, until

CELL = load_cell("ur5")
CONFIG = service_config(CELL, "outline_scene", outline_scene.Config)
AROUND = CELL.section(Surroundings)
assert isinstance(AROUND, Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
HOME = CELL.robot.named_poses["home"]
TOP, BASE = 1.65, 1.75  # depths [m] of a cube's top and of its support
CUBE_DEPTH = np.full((CAMERA.height, CAMERA.width), BASE, np.float32)  # of a cube in the middle, 200 pixels wide
CUBE_DEPTH[284:485, 412:613] = TOP


def contours(found: list[Contour], stamp: int = 0) -> Contours:
    return Contours(header=m.Header(stamp=stamp), width=CAMERA.width, height=CAMERA.height, contours=found, selected=0)


def cube_contours(stamp: int = 0) -> Contours:
    side = np.arange(201)
    pixels = [*((412 + k, 284) for k in side), *((612, 284 + k) for k in side[1:]),
              *((612 - k, 484) for k in side[1:]), *((412, 484 - k) for k in side[1:-1])]
    return contours([Contour.model_validate({"index": 0, "label": "Object_0", "area": 4e4, "pixels": [
        (float(u), float(v)) for u, v in pixels]})], stamp)


def noise_contours() -> Contours:
    """Return hundreds of small contours."""
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    for row in range(5):
        for column in range(5):
            image[20 + row:-20:36, 20 + column:-20:36] = (0, 0, 255)
    return contours(find_contours(image, ContourOptions()))


def huge_contours() -> Contours:
    corners = [(-1e12, -1e12), (1e12, -1e12), (1e12, 1e12), (-1e12, 1e12)]
    return contours([Contour.model_construct(index=i, label=f"Object_{i}", pixels=corners) for i in range(1000)])


class Cell(FakeCell):
    """A depth camera above a cube, its contours, and the arm."""

    def __init__(self) -> None:
        super().__init__()
        self.scenes = self.reader(topics.PLANNING_SCENE)
        self.calibrate(CAMERA, AROUND.camera.frame, topics.DEPTH_CAMERA_INFO)

    async def move(self, q: list[float], stamp: int) -> None:
        self.put_joints(CELL.robot.joints, q, stamp)
        await settle()

    async def expose(self, found: Contours) -> None:
        self.put_image(topics.DEPTH_CAMERA_DEPTH, CUBE_DEPTH, "32FC1", found.header.stamp, AROUND.camera.frame)
        self.put(CONTOURS, found)
        await settle()


async def test_scene_has_fixtures_and_the_solids_of_images_taken_at_home() -> None:
    cell, future = Cell(), 2**63 - 1
    async with cell.running(outline_scene, CONFIG):
        assert [o.id for o in (await until(cell.scenes)).objects] == ["robot_base", "target_base"]
        await cell.move([0.0] * 6, 1)
        await cell.expose(cube_contours(5))
        await cell.move(HOME, 10)
        await cell.expose(cube_contours(15))
        scene = await until(cell.scenes)
        cube = scene.objects[-1]
        assert (scene.header.stamp, cube.id, cube.shape) == (15, "Object_0", "prism"), "the arm was away before"
        position, half = cube.pose.position, 200 * TOP / CAMERA.fx / 2
        assert np.allclose((position.x, position.y, position.z), (0.5, 0.0, 1.05), atol=0.002)
        assert np.allclose(np.abs(np.array(cube.outline)).max(axis=0), half, atol=0.001)
        for stamp in (future, 20):
            await cell.expose(cube_contours(stamp))
            assert (await until(cell.scenes)).header.stamp == stamp, "a future image does not block later ones"
        log = cell.reader(topics.LOG)
        await cell.expose(noise_contours().model_copy(update={"header": m.Header(stamp=25)}))
        await until(log, lambda line: "are more than a planning scene has room for" in line.message)
        await cell.expose(cube_contours(30))
        assert (await until(cell.scenes)).header.stamp == 30


def test_encoding_identifies_depth_in_millimeters() -> None:
    image = array_to_image(np.rint(1000 * CUBE_DEPTH).astype(np.uint16), "16UC1")
    cube = outline_scene.seen(cube_contours(), image, CAMERA, AROUND).objects[-1]
    assert cube.id == "Object_0" and abs(cube.pose.position.z - 1.05) < 0.002


@pytest.mark.parametrize(("depth", "found", "camera", "problem"), [
    (np.full_like(CUBE_DEPTH, np.nan), cube_contours, {}, "no valid depth at all"),
    (CUBE_DEPTH[::2, ::2], cube_contours, {}, f"512x384, but the color image is {CAMERA.width}x{CAMERA.height}"),
    (CUBE_DEPTH, huge_contours, {}, "its 1000 contours cover it more than 20 times"),
    (CUBE_DEPTH, cube_contours, {"fx": 1e-6}, r"more than 1e\+07 m away"),
    (CUBE_DEPTH, cube_contours, {"cy": 1e12}, r"more than 1e\+07 m away"),
], ids=["no depth", "another size", "overlapping", "far by its width", "far by its center"])
def test_unusable_image_gives_no_scene(depth: Any, found: Any, camera: dict[str, float], problem: str) -> None:
    image = array_to_image(np.ascontiguousarray(depth), "32FC1")
    with pytest.raises(FrameError, match=problem):
        outline_scene.seen(found(), image, replace(CAMERA, **camera), AROUND)
    if camera:
        with pytest.raises(FrameError, match=problem):
            pixel_to_world.outline(found(), image, replace(CAMERA, **camera), pixel_to_world.Config())
