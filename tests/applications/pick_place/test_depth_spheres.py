"""Detection with depth: stacked, touching and noisy balls; the upper one is taken first."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from applications.pick_place import depth_spheres as depth_balls
from applications.pick_place.choice import Choice, lies_below
from applications.pick_place.detector import Detector
from applications.pick_place.grasping import Target
from applications.pick_place.outliers import NOT_ROUND
from common import messages as m
from common.config import Surroundings, load_cell
from common.messages import Color, Pose, Vector3, WorldObject
from common.perception.pinhole import Pinhole
from common.sim.rendering import Renderer
from tests.applications.pick_place.cell_double import CellDouble

AROUND = load_cell("panda").section(Surroundings)
assert isinstance(AROUND, Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
R = AROUND.ball_radius
PYRAMID = [(0.30, 0.10, R), (0.36, 0.10, R), (0.33, 0.152, R), (0.33, 0.1173, 0.079)]
LAYOUTS = {
    "apart": [(0.4, -0.3, R), (0.6, 0.0, R), (0.2, 0.1, R)],
    "touching": [(0.4, -0.3, R), (0.46, -0.3, R), (0.4, -0.24, R)],
    "stacked off the axis": [(0.6, -0.3, R), (0.6, -0.3, 3 * R)],
    "pyramid": PYRAMID,
}


def thing(at: tuple[float, float, float], shape: str = "sphere", *size: float) -> WorldObject:
    x, y, z = size or (2 * R, 2 * R, 2 * R)
    return WorldObject(id=f"{at}", shape=shape, pose=Pose(position=Vector3(x=at[0], y=at[1], z=at[2])),
                       size=Vector3(x=x, y=y, z=z), color=Color(r=1.0, g=0.15, b=0.1))


def look(things: list[WorldObject], noise: float = 0.0) -> tuple[Detector, np.ndarray]:
    view = Renderer(AROUND, camera=CAMERA).render(things)
    rng = np.random.default_rng(1)
    depth = view.depth_within(0.1, 2.0) + np.float32(noise) * rng.standard_normal(view.depth.shape, dtype=np.float32)
    detector = Detector(AROUND)
    found = detector.detect_in_depth(view.colour, depth, CAMERA)
    return detector, np.array([one.position for one in found]).reshape(-1, 3)


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize(("noise", "most"), [(0.0, 0.001), (0.002, 0.005)])
def test_stacked_and_single_balls_are_found_at_their_positions(name: str, noise: float, most: float) -> None:
    detector, found = look([thing(at) for at in LAYOUTS[name]], noise)
    assert len(found) == len(LAYOUTS[name]) and detector.outliers == []
    assert all(np.linalg.norm(found - np.array(at), axis=1).min() < most for at in LAYOUTS[name])


def test_occluded_lower_ball_is_found_after_the_upper_is_gone() -> None:
    lower, upper = (0.42, 0.02, R), (0.42, 0.02, 3 * R)
    _, both = look([thing(lower), thing(upper)])
    _, left = look([thing(lower)])
    np.testing.assert_allclose(both, [upper], atol=0.001)
    np.testing.assert_allclose(left, [lower], atol=0.001)


def test_cube_is_an_outlier() -> None:
    detector, found = look([thing((0.5, -0.1, 0.025), "box", 0.05, 0.05, 0.05), thing((0.3, 0.1, R))])
    assert len(found) == 1 and [one.reason for one in detector.outliers] == [NOT_ROUND]


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize(("shape", "size"), [
    ("cylinder", (0.04, 0.04, 0.001)),  # as wide as the part of a ball that differs from a plane
    ("cylinder", (0.04, 0.04, 0.12)),
    ("box", (0.2, 0.15, 0.001)),  # at its edges a ball would be seen only in part, too
])
def test_flat_object_is_an_outlier(shape: str, size: tuple[float, float, float], noise: float) -> None:
    detector, found = look([thing((0.4, 0.0, size[2] / 2), shape, *size), thing((0.3, 0.2, R))], noise)
    assert len(found) == 1 and [one.reason for one in detector.outliers] == [NOT_ROUND]


def test_balls_on_a_red_cloth_are_found_with_few_attempts(monkeypatch: pytest.MonkeyPatch) -> None:
    tries, fitted = [], depth_balls._fitted
    monkeypatch.setattr(depth_balls, "_fitted", lambda *given: tries.append(1) or fitted(*given))
    places = [(0.4, -0.1, 0.002 + R), (0.5, 0.05, 0.002 + R)]
    cloth = thing((0.45, -0.05, 0.001), "box", 0.6, 0.5, 0.002)
    _, found = look([cloth, *map(thing, places)])
    assert all(np.linalg.norm(found - np.array(at), axis=1).min() < 0.001 for at in places)
    assert len(found) == len(places) and len(tries) < 40


def test_outliers_are_reported_again_after_detection_with_depth() -> None:
    view = Renderer(AROUND, camera=CAMERA).render([thing(at) for at in PYRAMID])
    detector = Detector(AROUND)
    detector.detect(view.colour, CAMERA)
    without = detector.outliers
    detector.detect_in_depth(view.colour, view.depth_within(0.1, 2.0), CAMERA)
    assert without and not detector.outliers
    detector.detect(view.colour, CAMERA)
    assert detector.outliers == without


def test_nothing_red_gives_nothing() -> None:
    detector, found = look([])
    assert len(found) == 0 and detector.outliers == [] and detector.blind == ""


def test_upper_ball_is_taken_before_nearer_ones() -> None:
    for order in itertools.permutations(PYRAMID):
        cell = CellDouble([])
        cell.balls = {f"track_{k}": at for k, at in enumerate(order)}
        view = cell.view()
        choice = Choice(cell.task.p, AROUND.container, R)  # type: ignore[arg-type]
        for origin in ((0.0, 0.0), (0.36, 0.10), (0.5, 0.5)):
            chosen = choice.next(view, origin, [])
            assert chosen is not None and chosen.target.position == PYRAMID[-1]


def test_lower_ball_is_taken_after_the_upper_one() -> None:
    cell = CellDouble([])
    cell.balls = {f"track_{k}": at for k, at in enumerate(PYRAMID[:-1])}
    chosen = Choice(cell.task.p, AROUND.container, R).next(cell.view(), (0.3, 0.1), [])  # type: ignore[arg-type]
    assert chosen is not None and chosen.target.position == PYRAMID[0]


def test_ball_is_below_another_only_if_it_carries_it() -> None:
    lower, upper, near = (Target(name, at, R) for name, at in (
        ("lower", (0.4, 0.0, R)), ("upper", (0.42, 0.0, 0.085)), ("near", (0.47, 0.0, 0.085))))
    assert lies_below(lower, [lower, upper]) and not lies_below(upper, [lower, upper])
    assert not lies_below(lower, [lower, near])


def test_stacked_balls_are_two_objects_of_the_task() -> None:
    cell = CellDouble([])
    cell.balls = {"track_1": (0.4, 0.0, R), "track_2": (0.4, 0.0, 3 * R)}
    view = cell.view()
    upper = next(ball for ball in view.balls() if ball.id == "track_2")
    assert [ball.id for ball in view.others(upper, R)] == ["track_1"]
    assert dataclasses.replace(view, seen=m.PoseArray()).targets == []
