import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from applications.pick_place.ball_places import Resting
from common.config import Grasp, Surroundings, check, load_cell
from common.errors import ConfigError
from common.perception.pinhole import Pinhole
from common.planning.ik import solve_ik
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.scene import workspace
from common.scene.workspace import (
    ReachCache,
    WorkspaceBounds,
    chain_reason,
    outside_reason,
    reach_reason,
)

bounds = WorkspaceBounds()
around = Surroundings()
camera = Pinhole.from_config(around.camera)


@pytest.fixture(scope="module")
def robot():
    return RobotModel.load(load_cell("panda").robot)


@pytest.mark.parametrize(
    ("position", "reason"),
    [
        ((0.05, 0.03, 0.03), "singularity column: 0.058 m from the base axis, less than 0.080 m"),
        ((0.10, 0.10, 0.03), "too close: 0.141 m from the base axis, less than 0.180 m"),
        ((0.70, 0.45, 0.03), "too far: 0.832 m from the base axis, more than 0.820 m"),
        ((0.50, 0.0, -0.06), "too low: height -0.060 m is below -0.050 m"),
        ((0.50, 0.0, 0.99), "too high: height 0.990 m is above 0.980 m"),
    ],
)
def test_a_place_out_of_bounds_is_named_with_value_and_bound(position, reason):
    assert outside_reason(bounds, position) == reason


def test_singularity_column_is_tested_before_everything_else():
    assert outside_reason(bounds, (0.0, 0.0, 2.0)).startswith("singularity column")


@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(-0.3, 1.2))
def test_bounds_are_exactly_the_shell(x, y, z):
    within = 0.18 <= math.hypot(x, y) <= 0.82 and -0.05 <= z <= 0.98
    assert (outside_reason(bounds, (x, y, z)) == "") == within


def test_bounds_that_leave_nothing_are_refused():
    with pytest.raises(ConfigError, match=r"min_radius 0\.9 is not below max_radius 0\.82"):
        check(WorkspaceBounds, {"min_radius": 0.9})


@pytest.mark.parametrize("radius", [0.30, 0.45, 0.60, 0.75, 0.79])
@pytest.mark.parametrize("angle", [-0.6, 0.0, 0.5])
def test_places_on_the_table_within_reach_have_the_whole_chain(robot, radius, angle):
    assert reach_reason(robot, (radius * math.cos(angle), radius * math.sin(angle), 0.03)) == ""


def test_a_place_within_bounds_can_still_be_out_of_reach_and_the_stage_is_named(robot):
    assert reach_reason(robot, (0.2, 0.0, 0.03)).startswith(
        "pre-grasp at (0.200, 0.000, 0.130) has no inverse kinematics with any of 8"
    )


def test_the_stage_that_fails_is_named(robot):
    deep = Grasp(approach_clearance=0.3, lift_height=0.3)
    assert chain_reason(robot, (0.27, 0.0, 0.03), Grasp(), bounds).startswith("straight line down to")
    assert chain_reason(robot, (0.78, 0.0, 0.03), Grasp(lift_height=0.45), bounds).startswith("lift to")
    assert chain_reason(robot, (0.79, 0.0, 0.03), deep, bounds).startswith("pre-grasp at (0.790, 0.000, 0.330)")


def test_the_grasp_never_goes_below_the_floor(robot):
    sunk = chain_reason(robot, (0.85, 0.0, -0.04), Grasp(), bounds)
    assert "pre-grasp at (0.850, 0.000, 0.112)" in sunk


@given(st.floats(0.3, 0.75), st.floats(-0.8, 0.8))
@settings(max_examples=15, deadline=None)
def test_an_accepted_place_really_has_solutions_within_limits(radius, angle):
    model = _shared_robot()
    place = (radius * math.cos(angle), radius * math.sin(angle), 0.03)
    if reach_reason(model, place) == "":
        for height in (0.03, 0.13, 0.18):
            q = solve_ik(model, tool_down(*place[:2], height), model.named("home"))
            assert q is not None and model.within_limits(q)
            np.testing.assert_allclose(model.fk(q)[:3, 3], (*place[:2], height), atol=1e-4)


_robots = []


def _shared_robot():
    if not _robots:
        _robots.append(RobotModel.load(load_cell("panda").robot))
    return _robots[0]


def test_a_place_is_computed_once_and_its_neighbourhood_shares_the_answer(robot, monkeypatch):
    calls = []
    monkeypatch.setattr(workspace, "chain_reason", lambda _r, position, _g, _b: calls.append(position) or "because")
    cache = ReachCache(robot)
    assert cache.known((0.5, 0.1, 0.03)) is None
    assert [cache.reason((0.5 + d, 0.1, 0.03)) for d in (0.0, 0.0005, -0.0005)] == ["because"] * 3
    assert cache.known((0.5, 0.1, 0.03)) == "because"
    assert len(calls) == 1
    cache.reason((0.51, 0.1, 0.03))
    assert len(calls) == 2


def test_out_of_bounds_needs_no_inverse_kinematics(robot, monkeypatch):
    monkeypatch.setattr(workspace, "chain_reason", lambda *_: pytest.fail("asked for inverse kinematics"))
    assert ReachCache(robot).known((0.0, 0.0, 0.03)).startswith("singularity")


def test_the_cache_forgets_the_longest_unused(robot, monkeypatch):
    monkeypatch.setattr(workspace, "chain_reason", lambda *_: "")
    cache = ReachCache(robot, size=2)
    for x in (0.3, 0.4):
        cache.reason((x, 0.0, 0.03))
    cache.known((0.3, 0.0, 0.03))
    cache.reason((0.5, 0.0, 0.03))
    assert cache.known((0.4, 0.0, 0.03)) is None
    assert cache.known((0.3, 0.0, 0.03)) == ""


@pytest.mark.parametrize("z", [0.035, 0.095])
@pytest.mark.parametrize("dx", [-0.033, 0.033])
@pytest.mark.parametrize("dy", [-0.033, 0.033])
def test_every_ball_in_the_box_is_inside_the_container_by_its_ray(dx, dy, z):
    assert Resting.of(around).shows_container(camera, camera.project((0.55 + dx, 0.25 + dy, z)))


def test_balls_beside_the_box_are_not_inside():
    c = around.container
    reach = c.half_side + 0.04 + around.ball_radius
    for x, y in ((c.x - reach, c.y), (c.x, c.y - reach), (c.x + reach, c.y + reach)):
        assert not Resting.of(around).shows_container(camera, camera.project((x, y, 0.03)))


@given(st.floats(0, 639), st.floats(0, 479))
def test_the_ray_test_agrees_with_points_along_the_ray(u, v):
    origin, direction = camera.ray((u, v))
    along = origin + np.linspace(0.6, 1.2, 4000)[:, None] * direction
    c = around.container
    h = c.half_side
    within = (np.abs(along - (c.x, c.y, 0.0)) <= (h, h, 0.125)).all(axis=1) & (along[:, 2] >= 0)
    grazing = (np.abs(along - (c.x, c.y, 0.0)) <= (h + 0.001, h + 0.001, 0.126)).all(axis=1) & (along[:, 2] >= -0.001)
    if within.any() or not grazing.any():
        assert Resting.of(around).shows_container(camera, (u, v)) == bool(within.any())
