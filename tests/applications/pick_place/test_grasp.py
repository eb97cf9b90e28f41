from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.grasping import Config, HandShape, Target, finger_clearance, grasp_yaws, yaws_of
from common.config import Container, load_cell, service_config
from common.robot.transforms import tool_down
from common.scene.workspace import yaw_candidates

HAND = HandShape()


def test_yaws_cover_half_a_turn_smallest_first() -> None:
    yaws = yaw_candidates(8)
    assert yaws[0] == 0
    assert sorted(round(math.degrees(y), 1) for y in yaws) == [-67.5, -45, -22.5, 0, 22.5, 45, 67.5, 90]


def test_lone_ball_is_taken_without_turning() -> None:
    assert grasp_yaws(HAND, (0.4, 0.0), [], 0.03)[0] == 0


def test_neighbor_along_the_fingers_forces_a_rotation() -> None:
    axis = tool_down(0, 0, 0, 0.0)[:2, 1]
    neighbour = tuple(np.array([0.4, 0.0]) + 0.07 * axis)
    yaws = grasp_yaws(HAND, (0.4, 0.0), [neighbour], 0.03)
    assert yaws and 0 not in yaws


@pytest.mark.parametrize("yaw", yaw_candidates(8))
def test_clearance_is_least_along_the_finger_axis_of_that_yaw(yaw: float) -> None:
    axis = tool_down(0, 0, 0, yaw)[:2, 1]
    side = tool_down(0, 0, 0, yaw)[:2, 0]
    along = finger_clearance(HAND, (0, 0), yaw, [tuple(0.08 * axis)], 0.03)
    across = finger_clearance(HAND, (0, 0), yaw, [tuple(0.08 * side)], 0.03)
    assert along == pytest.approx(0.08 - 0.056 - 0.03)
    assert across > along


def test_ring_of_touching_neighbors_leaves_no_yaw() -> None:
    ring = [(0.4 + 0.062 * math.cos(a), 0.062 * math.sin(a)) for a in np.arange(6) * math.pi / 3]
    assert grasp_yaws(HAND, (0.4, 0.0), ring, 0.03) == []


def test_walls_of_the_container_are_cleared() -> None:
    box = Container()
    near = (box.x, box.y - box.half_side - 0.045)
    assert finger_clearance(HAND, near, 0.0, [], 0.03, box) < 0
    assert finger_clearance(HAND, near, math.pi / 2, [], 0.03, box) > 0.02


@given(st.floats(-math.pi, math.pi))
def test_a_box_is_taken_by_its_narrow_sides_with_the_pads_flat_on_them(yaw: float) -> None:
    target = Target("box", (0.4, 0.0, 0.03), 0.06, (0.1, 0.03), yaw)
    (found,) = yaws_of(target, HAND) or []
    fingers = tool_down(0, 0, 0, found)[:2, 1]
    assert abs(fingers @ [math.cos(yaw), math.sin(yaw)]) < 1e-9, "along its short side"
    assert -math.pi / 2 <= found <= math.pi / 2


def test_cube_has_two_yaws_and_a_too_wide_box_none() -> None:
    assert yaws_of(Target("cube", (0.4, 0.0, 0.03), 0.03, (0.04, 0.04), 0.1), HAND) == pytest.approx(
        [0.1, 0.1 - math.pi / 2])
    assert yaws_of(Target("crate", (0.4, 0.0, 0.03), 0.08, (0.1, 0.1)), HAND) == []
    assert yaws_of(Target("ball", (0.4, 0.0, 0.03), 0.03), HAND) is None


def test_clearance_uses_the_radius_of_each_neighbor() -> None:
    near = (0.4 + 0.0, 0.09)
    assert finger_clearance(HAND, (0.4, 0.0), 0.0, [(*near, 0.02)], 0.03) == pytest.approx(0.09 - 0.056 - 0.02)
    assert finger_clearance(HAND, (0.4, 0.0), 0.0, [near], 0.03) == pytest.approx(0.09 - 0.056 - 0.03)


def test_hand_has_the_shape_of_the_robot_files_gripper() -> None:
    hand = service_config(load_cell("panda"), "smart_pick_place", Config).hand
    assert (hand.finger_inner, hand.finger_outer, hand.finger_half_width) == (0.040, 0.056, 0.011)
    wider = load_cell("panda", ["robot.gripper.fingers={depth: 0.02, half_width: 0.015}"])
    hand = service_config(wider, "smart_pick_place", Config).hand
    assert (hand.finger_inner, hand.finger_outer, hand.finger_half_width) == (0.04, 0.06, 0.015)


def test_deprecated_shape_parameters_warn() -> None:
    cell = load_cell("panda", ["services.smart_pick_place.hand={finger_half_width: 0.02, yaw_count: 4}"])
    with pytest.warns(FutureWarning, match=r"finger_half_width belongs to the robot file: gripper\.fingers\."):
        hand = service_config(cell, "smart_pick_place", Config).hand
    assert (hand.finger_half_width, hand.finger_outer, hand.yaw_count) == (0.02, 0.056, 4)
