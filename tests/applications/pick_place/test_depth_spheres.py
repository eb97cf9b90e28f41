"""Detection with depth: stacked, touching and noisy balls; the upper one is taken first."""

import dataclasses
import itertools

import numpy as np
import pytest

from applications.pick_place import depth_spheres
from applications.pick_place.choice import Choice, lies_below
from applications.pick_place.detector import Detector
from applications.pick_place.grasping import Target
from applications.pick_place.outliers import NOT_ROUND
from common import messages as m
from tests.applications.pick_place.cell_double import CellDouble
from tests.applications.pick_place.rendered import AROUND, CAMERA, R, ball, red, rendered

PYRAMID = [(0.30, 0.10, R), (0.36, 0.10, R), (0.33, 0.152, R), (0.33, 0.1173, 0.079)]
LAYOUTS = {
    "apart": [(0.4, -0.3, R), (0.6, 0.0, R), (0.2, 0.1, R)],
    "touching": [(0.4, -0.3, R), (0.46, -0.3, R), (0.4, -0.24, R)],
    "stacked off the axis": [(0.6, -0.3, R), (0.6, -0.3, 3 * R)],
    "pyramid": PYRAMID,
}


def look(things, noise=0.0):
    """Return the detector, and the positions (n, 3) of the balls that it found."""
    view = rendered(things)
    rng = np.random.default_rng(1)
    depth = view.depth_within(0.1, 2.0) + np.float32(noise) * rng.standard_normal(view.depth.shape, dtype=np.float32)
    detector = Detector(AROUND)
    found = detector.detect_in_depth(view.colour, depth, CAMERA)
    return detector, np.array([one.position for one in found]).reshape(-1, 3)


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize(("noise", "most"), [(0.0, 0.001), (0.002, 0.005)])
def test_stacked_and_single_balls_are_found_at_their_positions(name, noise, most):
    detector, found = look([ball(*at) for at in LAYOUTS[name]], noise)
    assert len(found) == len(LAYOUTS[name]) and detector.outliers == []
    assert all(np.linalg.norm(found - np.array(at), axis=1).min() < most for at in LAYOUTS[name])


def test_occluded_lower_ball_is_found_after_the_upper_is_gone():
    lower, upper = (0.42, 0.02, R), (0.42, 0.02, 3 * R)
    np.testing.assert_allclose(look([ball(*lower), ball(*upper)])[1], [upper], atol=0.001)
    np.testing.assert_allclose(look([ball(*lower)])[1], [lower], atol=0.001)


@pytest.mark.parametrize(("shape", "size", "noise"), [
    ("box", (0.05, 0.05, 0.05), 0.0),
    ("cylinder", (0.04, 0.04, 0.001), 0.0),  # as wide as the part of a ball that differs from a plane
    ("cylinder", (0.04, 0.04, 0.001), 0.002),
    ("cylinder", (0.04, 0.04, 0.12), 0.002),
    ("box", (0.2, 0.15, 0.001), 0.002),  # at its edges a ball would be seen only in part, too
])
def test_object_of_another_shape_is_an_outlier(shape, size, noise):
    detector, found = look([red(shape, (0.4, 0.0, size[2] / 2), size, yaw=0.0), ball(0.3, 0.2)], noise)
    assert len(found) == 1 and [one.reason for one in detector.outliers] == [NOT_ROUND]


def test_balls_on_a_red_cloth_are_found_with_few_attempts(monkeypatch):
    attempts, fitted = [], depth_spheres._fitted
    monkeypatch.setattr(depth_spheres, "_fitted", lambda *given: attempts.append(1) or fitted(*given))
    places = [(0.4, -0.1, 0.002 + R), (0.5, 0.05, 0.002 + R)]
    cloth = red("box", (0.45, -0.05, 0.001), (0.6, 0.5, 0.002), yaw=0.0)
    _, found = look([cloth, *(ball(*at) for at in places)])
    assert all(np.linalg.norm(found - np.array(at), axis=1).min() < 0.001 for at in places)
    assert len(found) == len(places) and len(attempts) < 40


def test_outliers_are_reported_again_after_detection_with_depth():
    view = rendered([ball(*at) for at in PYRAMID])
    detector = Detector(AROUND)
    detector.detect(view.colour, CAMERA)
    without = detector.outliers
    detector.detect_in_depth(view.colour, view.depth_within(0.1, 2.0), CAMERA)
    assert without and not detector.outliers
    detector.detect(view.colour, CAMERA)
    assert detector.outliers == without


def test_nothing_red_gives_nothing():
    detector, found = look([])
    assert len(found) == 0 and detector.outliers == [] and detector.blind == ""


def cell_with(balls):
    cell = CellDouble([])
    cell.balls = {f"track_{k}": at for k, at in enumerate(balls)}
    return cell, Choice(cell.task.p, AROUND.container, R)


def test_upper_ball_is_taken_before_nearer_ones_and_then_the_lower_ones():
    for order in itertools.permutations(PYRAMID):
        cell, choice = cell_with(order)
        for origin in ((0.0, 0.0), (0.36, 0.10), (0.5, 0.5)):
            assert choice.next(cell.view(), origin, []).target.position == PYRAMID[-1]
    cell, choice = cell_with(PYRAMID[:-1])
    assert choice.next(cell.view(), (0.3, 0.1), []).target.position == PYRAMID[0]


def test_ball_is_below_another_only_if_it_carries_it():
    lower, upper, near = (Target(name, at, R) for name, at in (
        ("lower", (0.4, 0.0, R)), ("upper", (0.42, 0.0, 0.085)), ("near", (0.47, 0.0, 0.085))))
    assert lies_below(lower, [lower, upper]) and not lies_below(upper, [lower, upper])
    assert not lies_below(lower, [lower, near])


def test_stacked_balls_are_two_objects_of_the_task():
    cell, _ = cell_with([(0.4, 0.0, R), (0.4, 0.0, 3 * R)])
    view = cell.view()
    upper = next(one for one in view.balls() if one.id == "track_1")
    assert [one.id for one in view.others(upper, R)] == ["track_0"]
    assert dataclasses.replace(view, seen=m.PoseArray()).targets == []
