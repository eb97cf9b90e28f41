"""Boxes of two colors in pictures of the simulated world, against their true poses."""

import math
from typing import Any

import numpy as np
import pytest

from common.config import CameraConfig, Surroundings
from common.messages import Color, Pose, Quaternion, Vector3, WorldObject
from common.perception import boxes
from common.perception.boxes import BoxDetector, BoxKind, BoxOptions, DetectedBox
from common.perception.camera_input import FrameError
from common.perception.pinhole import Pinhole
from common.sim.rendering import Renderer

RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.7, 0.2)
SIDE = 0.04  # [m]
AROUND = Surroundings.model_validate({
    "fixtures": [{"id": "table", "dimensions": [1.0, 1.2, 0.05], "position": [0.5, 0.0, -0.025]}],
    "camera": CameraConfig(fx=1000, fy=1000, position=(0.6, 0.0, 1.3)),
})
KINDS = {"red": BoxKind(color=RED, size=(SIDE, SIDE, SIDE)), "green": BoxKind(color=GREEN, size=(SIDE, SIDE, SIDE))}


def cube(name: str, x: float, y: float, z: float = SIDE / 2, yaw: float = 0.0, side: float = SIDE) -> WorldObject:
    r, g, b = RED if name.startswith("red") else GREEN
    return WorldObject(
        id=name, shape="box", size=Vector3(x=side, y=side, z=side), color=Color(r=r, g=g, b=b),
        pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))),
    )


def view_of(*cubes: WorldObject) -> tuple[Any, Any, Pinhole]:
    """Picture, depth and camera."""
    view = Renderer(AROUND)
    shown = view.render(list(cubes))
    return shown.colour, np.asarray(shown.depth, np.float32), view.camera


def seen(*cubes: WorldObject, **options: object) -> list[DetectedBox]:
    return BoxDetector(BoxOptions.model_validate({"kinds": KINDS, **options})).detect(*view_of(*cubes))


def quarter(angle: float) -> float:
    """What is left of an angle [rad] when quarter turns look the same."""
    return math.remainder(angle, math.pi / 2)


@pytest.mark.parametrize("yaw", [0.0, 0.3, math.pi / 4, 1.2, -2.0])
def test_kind_position_and_yaw_of_a_cube_are_detected(yaw: float) -> None:
    cubes = [cube("red", 0.45, -0.15, yaw=yaw), cube("green", 0.7, 0.2, yaw=-yaw)]
    for thing, box in zip(cubes, seen(*cubes), strict=True):
        assert box.kind == thing.id and not box.partial
        at = thing.pose.position
        np.testing.assert_allclose(box.position, (at.x, at.y, at.z), atol=0.0015)
        turned = yaw if thing.id == "red" else -yaw
        assert abs(quarter(box.yaw - turned)) < math.radians(3)


def test_top_of_a_stack_is_detected_at_its_height_without_walls() -> None:
    heights = [SIDE / 2, 1.5 * SIDE, 2.5 * SIDE]
    for names in (("red", "green", "red"), ("red", "red", "red")):
        stack = [cube(f"{name}_{k}", 0.75, 0.25, z) for k, (name, z) in enumerate(zip(names, heights, strict=True))]
        box, = seen(*stack)
        assert box.kind == "red" and box.position[2] == pytest.approx(2.5 * SIDE, abs=1e-3)


def test_touching_cubes_of_one_color_are_separated() -> None:
    boxes = seen(cube("red_1", 0.5, 0.0), cube("red_2", 0.5, SIDE), cube("red_3", 0.5, 2 * SIDE))
    assert sorted(round(box.position[1], 2) for box in boxes) == [0.0, 0.04, 0.08]


def test_region_of_another_size_is_not_detected() -> None:
    assert seen(cube("red", 0.5, 0.0, z=0.03, side=0.06), cube("green", 0.5, 0.2, z=0.0125, side=0.025)) == []


def test_partly_occluded_cube_is_not_detected() -> None:
    boxes = seen(cube("red", 0.6, 0.0), cube("green", 0.62, 0.02, z=0.09))
    assert [box.kind for box in boxes] == ["green"]


def test_other_colors_and_missing_depth_give_no_detection() -> None:
    assert seen(cube("red", 0.5, 0.0), kinds={"green": KINDS["green"]}) == []
    picture, depth, camera = view_of(cube("red", 0.5, 0.0))
    assert BoxDetector(BoxOptions(kinds=KINDS)).detect(picture, np.full_like(depth, np.nan), camera) == []


def test_noise_specks_are_skipped_and_a_cube_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[Any] = []
    faces = boxes._faces
    monkeypatch.setattr(boxes, "_faces", lambda *given: searched.append(given) or faces(*given))
    picture, depth, camera = view_of(cube("red", 0.45, -0.15))
    specks = picture[::3, ::3]
    specks[specks[..., 2] < 150] = (25, 25, 230)
    found = BoxDetector(BoxOptions(kinds=KINDS)).detect(picture, depth, camera)
    assert len(found) == 1 and len(searched) < 10


def test_invalid_camera_is_rejected() -> None:
    camera = Pinhole(1e-300, 50.0, 1e5, 24.0, 64, 48, np.eye(4))
    picture, depth = np.full((48, 64, 3), (25, 25, 230), np.uint8), np.full((48, 64), 1.0, np.float32)
    with pytest.raises(FrameError, match=r"more than 1e\+07 m away"):
        BoxDetector(BoxOptions(kinds=KINDS)).detect(picture, depth, camera)
