"""Grasp candidates on surfaces of known solids, for both grippers."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from applications.sorting.grasps.candidates import Candidates, Options, candidates
from applications.sorting.grasps.gripper_shape import GripperShape
from applications.sorting.grasps.height_map import HeightMap
from common.config import load_cell
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from tests.applications.sorting.surfaces import FLOOR, WALLS, Solid, box, cylinder, seen, sphere, union

ROBOTS = ("panda", "ur5")


@cache
def gripper(robot: str) -> GripperShape:
    return GripperShape.of(RobotGeometry(RobotModel.load(load_cell(robot).robot)))


def grasps(robot: str, *solids: Solid, noise: float = 0.0) -> Candidates:
    surface, labels = seen(solids, noise)
    return candidates(surface, labels, gripper(robot), Options(), np.random.default_rng(0), [WALLS])


def tips(robot: str, found: Candidates) -> float:
    """Height of the lowest tip above the floor while the fingers grip [m]."""
    shape = gripper(robot)
    down = found.T[:, :3, 3] + found.T[:, :3, 2] * shape.tip(found.width)[:, None]
    return float((down[:, 2] - FLOOR).min())


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("noise", [0.0, 0.0015])
@pytest.mark.parametrize(("solid", "center", "width", "axis"), [
    (box(0.6, 0.08, 0.09, 0.03, 0.04), (0.6, 0.08), 0.03, (0, 1)),
    (box(0.5, -0.08, 0.09, 0.03, 0.04, math.pi / 2), (0.5, -0.08), 0.03, (1, 0)),
    (box(0.6, -0.05, 0.09, 0.03, 0.04, 0.6), (0.6, -0.05), 0.03, (-math.sin(0.6), math.cos(0.6))),
    (cylinder(0.5, 0.1, 0.02, 0.05), (0.5, 0.1), 0.04, None),
    (sphere(0.5, 0.1, 0.03), (0.5, 0.1), 0.06, None),
    (box(0.55, 0.1, 0.08, 0.05, 0.005), (0.55, 0.1), 0.05, (0, 1)),  # a plate flat on the floor
])
def test_the_best_grasp_is_across_the_middle(
    robot: str, noise: float, solid: Solid, center: tuple[float, float], width: float, axis: tuple[float, float] | None
) -> None:
    found = grasps(robot, solid, noise=noise)
    assert found.reasons == {}
    assert found.T[0, :2, 3] == pytest.approx(center, abs=0.006)
    assert found.width[0] == pytest.approx(width, abs=0.006)
    assert found.width[0] + 0.007 < found.opening[0] <= gripper(robot).max_width
    if axis is not None:
        assert abs(found.axis(gripper(robot))[0, :2] @ axis) > math.cos(math.radians(12))
    assert tips(robot, found) >= 0.0015
    assert found.T[0, 2, 2] == pytest.approx(-1.0)
    assert np.linalg.det(found.T[0, :3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_ball_is_gripped_below_its_widest_height(robot: str) -> None:
    found = grasps(robot, sphere(0.5, 0.1, 0.03))
    assert tips(robot, found.select(np.array([0]))) < 0.028


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_ring_is_gripped_at_its_rim_with_a_finger_inside(robot: str) -> None:
    found = grasps(robot, cylinder(0.55, 0.0, 0.05, 0.03, hole=0.04))
    assert len(found) > 8
    assert np.hypot(*(found.T[:, :2, 3] - (0.55, 0.0)).T) == pytest.approx(0.045, abs=0.003)
    assert found.width.max() < 0.026


@pytest.mark.parametrize("robot", ROBOTS)
def test_an_angle_is_gripped_at_a_leg(robot: str) -> None:
    found = grasps(robot, union(box(0.55, 0.0, 0.10, 0.025, 0.03), box(0.5125, 0.0375, 0.025, 0.10, 0.03)))
    assert found.reasons == {}
    assert found.width[0] == pytest.approx(0.025, abs=0.005)


@pytest.mark.parametrize("robot", ROBOTS)
def test_two_touching_cubes_are_never_gripped_together(robot: str) -> None:
    found = grasps(robot, box(0.535, 0.0, 0.03, 0.03, 0.04), box(0.565, 0.0, 0.03, 0.03, 0.04))
    assert set(found.object) == {0, 1}
    assert (found.width < 0.045).all()
    best = np.array([np.flatnonzero(found.object == k)[0] for k in (0, 1)])
    assert (np.abs(found.axis(gripper(robot))[best, 1]) > 0.9).all()  # where they do not touch


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize(("solid", "along"), [
    (box(0.55 + 0.192 - 0.02, 0.0, 0.04, 0.04, 0.04), 1),
    (box(0.55 - 0.192 + 0.02, 0.0, 0.04, 0.04, 0.04), 1),
    (box(0.55, 0.192 - 0.02, 0.04, 0.04, 0.04), 0),
    (box(0.55, -0.192 + 0.02, 0.04, 0.04, 0.04), 0),
])
def test_an_object_at_a_wall_is_gripped_along_the_wall(robot: str, solid: Solid, along: int) -> None:
    found = grasps(robot, solid)
    assert found.reasons == {}
    assert abs(found.axis(gripper(robot))[0, along]) > 0.95


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize(("solids", "reason"), [
    ([box(0.55, 0.0, 0.12, 0.12, 0.04)], "wider than the"),
    ([box(0.722, 0.172, 0.04, 0.04, 0.04)], "opposite edges"),  # in the corner, lower than the walls
    ([box(0.55, 0.0, 0.04, 0.04, 0.03), *(box(0.55 + dx, dy, 0.06, 0.06, 0.06) for dx in (-0.06, 0, 0.06)
      for dy in (-0.06, 0, 0.06) if dx or dy)], ""),  # in a pit
])
def test_an_object_without_a_grasp_has_a_reason(robot: str, solids: list[Solid], reason: str) -> None:
    found = grasps(robot, *solids)
    assert 0 not in found.object
    assert reason in found.reasons[0]


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_high_object_in_a_corner_is_gripped_above_the_walls(robot: str) -> None:
    found = grasps(robot, box(0.55 + 0.192 - 0.02, 0.192 - 0.02, 0.04, 0.04, 0.09))
    assert found.reasons == {}
    assert tips(robot, found.select(np.array([0]))) > WALLS.top - FLOOR


@pytest.mark.parametrize("robot", ROBOTS)
def test_nothing_in_the_tray_has_no_candidates(robot: str) -> None:
    found = grasps(robot)
    assert len(found) == 0
    assert found.reasons == {}


def test_unknown_cells_are_as_high_as_their_neighbors() -> None:
    surface, labels = seen([box(0.55, 0.0, 0.04, 0.04, 0.04), box(0.62, 0.0, 0.03, 0.2, 0.06)])
    clear = candidates(surface, labels, gripper("panda"), Options(), np.random.default_rng(0), [WALLS])
    columns = slice(int(0.22 / 0.002), int(0.255 / 0.002))  # between the two
    surface.top[:, columns] = np.nan
    labels[:, columns] = 0
    hidden = candidates(surface, labels, gripper("panda"), Options(), np.random.default_rng(0), [WALLS])
    across = [np.abs(each.axis(gripper("panda"))[each.object == 0, 0]) > 0.9 for each in (clear, hidden)]
    assert across[0].any()
    assert not across[1].any()


@pytest.mark.parametrize("robot", ROBOTS)
def test_tilting_frees_the_palm_from_a_high_wall(robot: str) -> None:
    high = replace(WALLS, top=0.15)
    surface, labels = seen([box(0.55 + 0.192 - 0.018, 0.0, 0.03, 0.04, 0.04)])

    def found(tilts: tuple[float, ...]) -> Candidates:
        options = Options(tilts=tilts)
        return candidates(surface, labels, gripper(robot), options, np.random.default_rng(0), [high])

    upright, tilted = found(()), found((0.26, 0.52))
    assert len(upright) == 0
    assert "palm" in upright.reasons[0]
    assert tilted.reasons == {}
    assert tilted.T[0, 0, 2] > 0.2  # the tool points towards the wall: the palm is away from it
    points = gripper(robot).surfaces.placed(tilted.T @ gripper(robot).T_tcp_closing, tilted.opening)
    above = HeightMap(surface, labels, [high]).penetration(points, 0)[0]
    assert (above < 0).all()


@pytest.mark.parametrize("robot", ROBOTS)
def test_candidates_of_a_heap_are_many_and_differ(robot: str) -> None:
    solids = [box(0.45 + 0.1 * i, 0.1 * j, 0.06, 0.03, 0.04, i + 2.0 * j) for i in range(3) for j in (-1, 0, 1)]
    found = grasps(robot, *solids, noise=0.001)
    counts = np.bincount(found.object, minlength=9)
    assert (counts >= 3).all()
    assert (np.diff(found.score) <= 0).all()
    for index in range(9):
        own = np.flatnonzero(found.object == index)
        at = found.T[own][:, :3, 3]
        away = np.linalg.norm(at[:, None] - at, axis=2)
        turned = np.abs(found.axis(gripper(robot))[own] @ found.axis(gripper(robot))[own].T)
        assert not ((away < 0.0099) & (turned > math.cos(0.25)) & ~np.eye(len(own), dtype=bool)).any()


def test_other_scores_change_the_order() -> None:
    found = grasps("panda", box(0.55, 0.0, 0.09, 0.03, 0.04))
    order = np.random.default_rng(1).permutation(len(found))
    ranked = found.ranked(-order.astype(float))
    np.testing.assert_array_equal(ranked.T, found.T[np.argsort(order)])
    assert (np.diff(ranked.score) < 0).all()
