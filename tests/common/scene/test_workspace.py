import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.config import Grasp, check, load_cell
from common.errors import ConfigError
from common.planning.ik import solve_ik
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.scene import workspace
from common.scene.workspace import ReachCache, WorkspaceBounds, out_of_bounds_reason, unreachable_reason

BOUNDS = WorkspaceBounds()
ROBOT = RobotModel.load(load_cell("panda").robot)


@pytest.mark.parametrize(("position", "reason"), [
    ((0.05, 0.03, 0.03), "singularity column: 0.058 m from the base axis, less than 0.080 m"),
    ((0.10, 0.10, 0.03), "too close: 0.141 m from the base axis, less than 0.180 m"),
    ((0.70, 0.45, 0.03), "too far: 0.832 m from the base axis, more than 0.820 m"),
    ((0.50, 0.0, -0.06), "too low: height -0.060 m is below -0.050 m"),
    ((0.50, 0.0, 0.99), "too high: height 0.990 m is above 0.980 m"),
    ((0.0, 0.0, 2.0), "singularity column: 0.000 m from the base axis, less than 0.080 m"),  # checked first
])
def test_out_of_bounds_reason_names_value_and_bound(position, reason):
    assert out_of_bounds_reason(BOUNDS, position) == reason


@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(-0.3, 1.2))
def test_bounds_are_exactly_the_shell(x, y, z):
    within = 0.18 <= math.hypot(x, y) <= 0.82 and -0.05 <= z <= 0.98
    assert (out_of_bounds_reason(BOUNDS, (x, y, z)) == "") == within


def test_empty_bounds_are_refused():
    with pytest.raises(ConfigError, match=r"min_radius 0\.9 is not below max_radius 0\.82"):
        check(WorkspaceBounds, {"min_radius": 0.9})


@given(st.floats(0.3, 0.79), st.floats(-0.8, 0.8))
@settings(max_examples=15, deadline=None)
def test_positions_on_the_table_within_reach_have_the_complete_chain_within_limits(radius, angle):
    place = (radius * math.cos(angle), radius * math.sin(angle), 0.03)
    assert unreachable_reason(ROBOT, place) == ""
    for height in (0.03, 0.13, 0.18):
        q = solve_ik(ROBOT, tool_down(*place[:2], height), ROBOT.named("home"))
        assert q is not None and ROBOT.within_limits(q)
        np.testing.assert_allclose(ROBOT.fk(q)[:3, 3], (*place[:2], height), atol=1e-4)


@pytest.mark.parametrize(("position", "grasp", "reason"), [
    ((0.2, 0.0, 0.03), Grasp(), "pre-grasp at (0.200, 0.000, 0.130) has no inverse kinematics with any of 8"),
    ((0.27, 0.0, 0.03), Grasp(), "straight line down to"),
    ((0.78, 0.0, 0.03), Grasp(lift_height=0.45), "lift to"),
    ((0.79, 0.0, 0.03), Grasp(approach_clearance=0.3, lift_height=0.3), "pre-grasp at (0.790, 0.000, 0.330)"),
    ((0.85, 0.0, -0.04), Grasp(), "pre-grasp at (0.850, 0.000, 0.112)"),  # the grasp is never below the floor
])
def test_reason_names_the_stage_that_fails(position, grasp, reason):
    assert workspace.grasp_chain_failure(ROBOT, position, grasp, BOUNDS).startswith(reason)


def test_cache_computes_once_per_grid_cell_and_nothing_out_of_bounds():
    calls = []
    cache = ReachCache(ROBOT, compute=lambda _r, position, _g, _b: calls.append(position) or "because")
    assert cache.known((0.5, 0.1, 0.03)) is None
    assert [cache.reason((0.5 + d, 0.1, 0.03)) for d in (0.0, 0.0005, -0.0005)] == ["because"] * 3
    assert cache.known((0.5, 0.1, 0.03)) == "because"
    assert cache.known((0.0, 0.0, 0.03)).startswith("singularity") and len(calls) == 1
    cache.reason((0.51, 0.1, 0.03))
    assert len(calls) == 2


def test_cache_drops_the_least_recently_used():
    cache = ReachCache(ROBOT, size=2, compute=lambda *_: "")
    for x in (0.3, 0.4):
        cache.reason((x, 0.0, 0.03))
    cache.known((0.3, 0.0, 0.03))
    cache.reason((0.5, 0.0, 0.03))
    assert cache.known((0.4, 0.0, 0.03)) is None and cache.known((0.3, 0.0, 0.03)) == ""
