"""Red objects that are no balls on the table are reported: cubes, cables, discs, stacked balls."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from applications.pick_place.detections import Validation
from applications.pick_place.detector import Detector, DetectorOptions
from applications.pick_place.outliers import COVERED, FLAT, NOT_ROUND, THIN
from common.config import CameraConfig, Surroundings, load_cell
from common.messages import Color, Vector3, WorldObject
from common.perception.pinhole import Pinhole
from common.perception.sphere import silhouettes
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform
from common.sim.rendering import Renderer
from services.vision_detector import _remark, markers
from tests.simulated.visited import SimulatedCell

AROUND = load_cell("panda").section(Surroundings)
assert isinstance(AROUND, Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
SIDE = CameraConfig(position=(1.15, 0.0, 0.85), rpy=(-2.4, 0.0, math.pi / 2))
PLACES = [(0.40, 0.0), (0.50, -0.10), (0.30, 0.20), (0.60, -0.30), (0.20, -0.35)]
OTHERS = [(0.25, -0.10), (0.62, 0.05), (0.15, 0.10)]


def red(shape: str, at: tuple[float, float, float], size: tuple[float, float, float], yaw: float = 0.4,
        roll: float = 0.0) -> WorldObject:
    pose = matrix_to_pose(transform(rpy_to_matrix(roll, 0, yaw), at))
    return WorldObject(id=f"{shape} {at}", shape=shape, pose=pose, size=Vector3(x=size[0], y=size[1], z=size[2]),
                       color=Color(r=1.0, g=0.15, b=0.1))


def ball(x: float, y: float, z: float = 0.03) -> WorldObject:
    return red("sphere", (x, y, z), (0.06, 0.06, 0.06))


def look(*things: WorldObject, others: bool = True) -> Detector:
    """Return a detector that processed them, with or without other balls, and found only those."""
    detector = Detector(AROUND)
    nearby = [ball(x, y) for x, y in OTHERS] if others else []
    found = detector.detect(Renderer(AROUND, camera=CAMERA).render([*things, *nearby]).colour, CAMERA)
    assert len(found) == len(nearby), found
    assert all(min(math.dist(one.position[:2], place) for place in OTHERS) < 0.003 for one in found)
    return detector


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("others", [True, False])
@pytest.mark.parametrize("side", [0.045, 0.05, 0.06])
def test_cube_is_detected_by_its_outline(place: tuple[float, float], side: float, others: bool) -> None:
    odd = look(red("box", (*place, side / 2), (side, side, side)), others=others).outliers
    assert {one.reason for one in odd} == {NOT_ROUND} and math.dist(odd[0].position[:2], place) < 0.03


@pytest.mark.parametrize("place", [(0.30, 0.455), (0.44, 0.455), (0.74, -0.08), (0.06, -0.12)])
def test_cube_cut_by_the_border_is_detected_by_its_outline(place: tuple[float, float]) -> None:
    odd = look(red("box", (*place, 0.035), (0.07, 0.07, 0.07))).outliers
    assert {one.reason for one in odd} == {NOT_ROUND}
    assert min(math.dist(one.position[:2], place) for one in odd) < 0.06


@pytest.mark.parametrize("place", PLACES)
def test_cable_is_detected_by_its_outline(place: tuple[float, float]) -> None:
    odd = look(red("cylinder", (*place, 0.01), (0.02, 0.02, 0.2), roll=math.pi / 2)).outliers
    assert {one.reason for one in odd} == {NOT_ROUND}


@pytest.mark.slow
@pytest.mark.parametrize("eye", [AROUND.camera, SIDE])
def test_thin_cable_is_reported_next_to_balls(eye: CameraConfig) -> None:
    camera, around = Pinhole.from_config(eye), AROUND.model_copy(update={"camera": eye})
    draw = Renderer(around, camera=camera)
    for width in (0.004, 0.006, 0.008):
        for place in PLACES:
            cable = red("cylinder", (*place, width / 2), (width, width, 0.25), roll=math.pi / 2)
            nearby = [ball(x, y) for x, y in OTHERS if math.dist((x, y), place) > 0.17]
            detector = Detector(around)
            assert len(detector.detect(draw.render([cable, *nearby]).colour, camera)) == len(nearby)
            assert [one.reason for one in detector.outliers] in ([THIN], [NOT_ROUND] * (width > 0.006)), (width, place)
            assert math.dist(detector.outliers[0].position[:2], place) < 0.06


def test_red_noise_is_no_cable() -> None:
    rng = np.random.default_rng(5)
    picture = Renderer(AROUND, camera=CAMERA).render([ball(x, y) for x, y in OTHERS]).colour.copy()
    for share in (0.01, 0.1, 0.3, 0.7):
        noisy = picture.copy()
        noisy[rng.random(picture.shape[:2]) < share] = (20, 20, 200)
        detector = Detector(AROUND)
        detector.detect(noisy, CAMERA)
        assert THIN not in {one.reason for one in detector.outliers}


@pytest.mark.parametrize("place", [(0.60, -0.30), (0.20, -0.35), (0.62, -0.25)])
def test_disc_off_axis_is_detected_by_its_shape(place: tuple[float, float]) -> None:
    for diameter in (0.06, 0.0624):  # the second one is as large in the picture as a ball
        odd = look(red("cylinder", (*place, 0.0005), (diameter, diameter, 0.001)), others=False).outliers
        assert [one.reason for one in odd] == [FLAT]


def test_disc_below_the_camera_is_detected_by_its_size() -> None:
    odd = look(red("cylinder", (0.40, 0.0, 0.0005), (0.06, 0.06, 0.001))).outliers
    assert len(odd) == 1 and "smaller than a ball on the table" in odd[0].reason


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("others", [True, False])
@pytest.mark.parametrize("height", [0.079, 0.09])
def test_ball_on_top_of_something_looks_too_large(place: tuple[float, float], height: float, others: bool) -> None:
    odd = look(ball(*place, height), others=others).outliers
    assert len(odd) == 1 and "larger than a ball on the table: it lies higher" in odd[0].reason


@pytest.mark.parametrize("place", PLACES)
def test_no_ball_of_a_stack_is_offered(place: tuple[float, float]) -> None:
    detector = look(ball(*place), ball(*place, 0.09))
    assert detector.outliers
    frame = markers([], AROUND, 1, odd=detector.outliers)
    assert all(marker.text for marker in frame.markers)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("others", [True, False])
def test_no_ball_of_a_stack_is_offered_to_a_side_camera(place: tuple[float, float], others: bool) -> None:
    camera, around = Pinhole.from_config(SIDE), AROUND.model_copy(update={"camera": SIDE})
    nearby = [ball(x, y) for x, y in OTHERS] if others else []
    picture = Renderer(around, camera=camera).render([ball(*place), ball(*place, 0.09), *nearby]).colour
    detector = Detector(around)
    assert len(detector.detect(picture, camera)) == len(nearby)
    assert sorted("it lies higher" in one.reason for one in detector.outliers) == [False, True]
    assert any(math.dist(one.position[:2], place) < 0.01 for one in detector.outliers), "the lower one is where it is"


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 0.006])
def test_three_balls_are_offered_only_without_one_on_top(gap: float) -> None:
    draw, away = Renderer(AROUND, camera=CAMERA), (0.06 + gap) / math.sqrt(3)
    for place in PLACES:
        for turn in (0.0, 0.7):
            around = [complex(*place) + away * np.exp(1j * (turn + third * math.tau / 3)) for third in range(3)]
            lower, top = [ball(z.real, z.imag) for z in around], ball(*place, 0.03 + math.sqrt(0.06**2 - away**2))
            found = Detector(AROUND).detect(draw.render(lower).colour, CAMERA)
            assert len(found) == 3, (place, turn)
            detector = Detector(AROUND)
            assert detector.detect(draw.render([*lower, top]).colour, CAMERA) == [], (place, turn)
            assert {one.reason for one in detector.outliers} == {COVERED}


@pytest.mark.parametrize("blur", [0.6, 1.3])
def test_three_touching_balls_are_offered_in_a_blurred_image(blur: float) -> None:
    away = 0.06 / math.sqrt(3)
    at = [0.30 + 0.20j + away * np.exp(1j * third * math.tau / 3) for third in range(3)]
    places = np.array([(z.real, z.imag, 0.03) for z in at] + [(x, y, 0.03) for x, y in OTHERS[:2]])
    picture = np.full((CAMERA.height, CAMERA.width, 3), 40, np.uint8)
    for outline in silhouettes(CAMERA, places, 0.03, 64):
        cv2.fillConvexPoly(picture, np.rint(outline).astype(np.int32), (25, 35, 200))
    detector = Detector(AROUND, DetectorOptions(outline_offset_px=1.0))
    assert len(detector.detect(cv2.GaussianBlur(picture, (0, 0), blur), CAMERA)) == len(places), detector.outliers


@pytest.mark.slow
@pytest.mark.parametrize("eye", [AROUND.camera, SIDE])
@pytest.mark.parametrize("others", [True, False])
def test_touching_balls_are_no_stack(eye: CameraConfig, others: bool) -> None:
    camera, around = Pinhole.from_config(eye), AROUND.model_copy(update={"camera": eye})
    draw, detector = Renderer(around, camera=camera), Detector(around)
    touching = [(0.45, -0.30), (0.51, -0.30), (0.48, -0.248), (0.45, -0.19)]
    for turn in np.linspace(0, 2 * math.pi, 12, endpoint=False):
        about = complex(0.48, -0.26)
        turned = [about + (complex(*place) - about) * np.exp(1j * turn) for place in touching]
        nearby = [ball(x, y) for x, y in OTHERS[1:]] if others else []
        picture = draw.render([*(ball(z.real, z.imag) for z in turned), *nearby]).colour
        assert len(detector.detect(picture, camera)) == len(touching) + len(nearby) and detector.outliers == []


def painted(camera: Pinhole, places: list[tuple[float, float]], wider: list[float], higher: list[float]) -> np.ndarray:
    """Balls whose outlines are so much further out than they should be [px], as light and noise have it."""
    fine = 8
    picture = np.full((camera.height * fine, camera.width * fine, 3), 40, np.uint8)
    drawn = silhouettes(camera, np.array([(x, y, 0.03) for x, y in places]), 0.03, 64)
    for outline, *more in zip(drawn, wider, higher, strict=True):
        away = outline - outline.mean(axis=0)
        moved = outline + away / np.abs(away).max(axis=0) * more
        cv2.fillConvexPoly(picture, np.rint((moved + 0.5) * fine - 0.5).astype(np.int32), (25, 35, 200))
    return cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(("wider", "higher"), [
    ([0.45] * 4, [-0.45] * 4), ([-0.45] * 4, [0.45] * 4), ([0.41, 0, 0, 0], [0.41, 0, 0, 0]),
])
def test_outline_tolerance_in_pixels_is_independent_of_distance(wider: list[float], higher: list[float]) -> None:
    camera, around = Pinhole.from_config(SIDE), AROUND.model_copy(update={"camera": SIDE})
    places = [(0.10, -0.40), (0.10, 0.10), (0.20, -0.20), (0.60, -0.10)]
    detector = Detector(around)
    found = detector.detect(painted(camera, places, wider, higher), camera)
    assert len(found) == len(places), detector.outliers
    assert all(min(math.dist(one.position[:2], place) for one in found) < 0.003 for place in places)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("others", [True, False])
@pytest.mark.parametrize("height", [0.079, 0.09])
def test_ball_on_top_of_something_looks_too_large_from_the_side(
    place: tuple[float, float], height: float, others: bool,
) -> None:
    camera, around = Pinhole.from_config(SIDE), AROUND.model_copy(update={"camera": SIDE})
    nearby = [ball(x, y) for x, y in OTHERS] if others else []
    detector = Detector(around)
    picture = Renderer(around, camera=camera).render([ball(*place, height), *nearby]).colour
    assert len(detector.detect(picture, camera)) == len(nearby)
    assert ["it lies higher" in one.reason for one in detector.outliers] == [True]


@pytest.mark.parametrize("places", [[(0.544, 0.265), (0.514, 0.21), (0.579, 0.216)], [(0.552, 0.273), (0.539, 0.214)]])
def test_ball_leaning_on_the_wall_carries_no_phantom_ball(places: list[tuple[float, float]]) -> None:
    things = [ball(x, y, 0.035) for x, y in places]
    found = Detector(AROUND).detect(Renderer(AROUND, camera=CAMERA).render(things).colour, CAMERA)
    assert len(found) == len(places)


@pytest.mark.parametrize("place", PLACES[:2])
@pytest.mark.parametrize(("diameter", "below"), [(0.07, 0.0), (0.1, 0.0), (0.06, 0.17)])
def test_much_larger_blob_is_counted_as_too_large(place: tuple[float, float], diameter: float, below: float) -> None:
    detector = look(red("sphere", (*place, below + diameter / 2), (diameter, diameter, diameter)))
    assert detector.too_large == 1 and detector.outliers == []
    assert _remark(detector, "eye") == "1 round red thing looks much larger than a ball on the table"
    assert look().too_large == 0 and _remark(look(), "eye") == ""


class Anywhere:
    """Reaches everything."""

    def known(self, _place: object) -> str:
        return ""


@pytest.mark.parametrize("depth", [None, 1.5])
@pytest.mark.parametrize("height", [40, 100])
def test_red_object_above_the_horizon_is_ignored(height: int, depth: float | None) -> None:
    camera = Pinhole.from_config(CameraConfig(position=(-1.0, 0.0, 0.6), rpy=(-math.pi / 2 - 0.2, 0.0, -math.pi / 2)))
    picture = np.full((camera.height, camera.width, 3), 128, np.uint8)
    cv2.rectangle(picture, (280, height - 20), (380, height + 20), (0, 0, 255), -1)
    detector = Detector(AROUND)
    if depth is None:
        found = detector.detect(picture, camera)
    else:
        found = detector.detect_in_depth(picture, np.full(picture.shape[:2], depth, np.float32), camera)
    assert found == [] and markers(found, AROUND, 0, odd=detector.outliers).markers == []


def test_outlier_is_rejected_with_the_detectors_reason() -> None:
    detector = look(red("box", (0.5, -0.1, 0.03), (0.06, 0.06, 0.06)))
    validation = Validation(AROUND, Anywhere())  # type: ignore[arg-type]
    reported = []
    for k in range(10):
        verdict = validation.validate(markers([], AROUND, 1 + k * 100_000_000, odd=detector.outliers), CAMERA)
        assert verdict.targets == [] and [why for _, why in verdict.refused] == [NOT_ROUND]
        reported.append([one.reason for one in verdict.rejections])
    assert [reasons for reasons in reported if reasons] == [[NOT_ROUND]] and reported[0] == [], "not what falls past"


CELL = """
cell: odd
robot: panda
pipeline: cartesian_ompl
application: pick_place
world:
  fixtures:
    - {id: table, dimensions: [1.0, 1.0, 0.05], position: [0.5, 0.0, -0.025], color: [0.55, 0.35, 0.10]}
  container: {id: box, x: 0.55, y: 0.25}
  objects:
    - {id: ball_1, shape: sphere, radius: 0.03, x: 0.5, y: -0.2, color: [1.0, 0.15, 0.1]}
    - {id: cube, shape: box, size: [0.05, 0.05, 0.05], x: 0.45, y: 0.05, color: [1.0, 0.15, 0.1]}
services:
  motion_planner: {}
  robot_state_publisher: {}
  trajectory_executor: {}
  camera_simulator: {}
  vision_detector: {}
  workspace_validator: {}
  scene_manager: {}
  smart_pick_place: {grace: 1.0}
"""


@pytest.mark.slow
def test_cell_takes_the_ball_and_reports_the_cube(tmp_path: Path) -> None:
    path = tmp_path / "odd.yaml"
    path.write_text(CELL, encoding="utf-8")
    summary = SimulatedCell(str(path)).summary
    assert (summary["state"], summary["placed"]) == ("DONE", 1), summary
    assert [one["reason"] for one in summary["rejected"]] == [NOT_ROUND]
    assert (summary["truth"]["in_box"], summary["truth"]["on_table"]) == (1, 1)
