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


def test_neighbors_along_the_fingers_force_a_rotation_or_leave_no_yaw():
    degrees = sorted(round(math.degrees(yaw), 1) for yaw in yaw_candidates(8))
    assert degrees == [-67.5, -45, -22.5, 0, 22.5, 45, 67.5, 90]
    assert grasp_yaws(HAND, (0.4, 0.0), [], 0.03)[0] == 0, "a lone ball is taken without turning"
    neighbor = tuple(np.array([0.4, 0.0]) + 0.07 * tool_down(0, 0, 0, 0.0)[:2, 1])
    yaws = grasp_yaws(HAND, (0.4, 0.0), [neighbor], 0.03)
    assert yaws and 0 not in yaws
    ring = [(0.4 + 0.062 * math.cos(a), 0.062 * math.sin(a)) for a in np.arange(6) * math.pi / 3]
    assert grasp_yaws(HAND, (0.4, 0.0), ring, 0.03) == []


@pytest.mark.parametrize("yaw", yaw_candidates(8))
def test_clearance_is_least_along_the_finger_axis_and_uses_the_radius_of_the_neighbor(yaw):
    side, axis = (tuple(0.08 * tool_down(0, 0, 0, yaw)[:2, k]) for k in (0, 1))
    along = finger_clearance(HAND, (0, 0), yaw, [axis], 0.03)
    assert along == pytest.approx(0.08 - 0.056 - 0.03)
    assert finger_clearance(HAND, (0, 0), yaw, [(*axis, 0.02)], 0.03) == pytest.approx(0.08 - 0.056 - 0.02)
    assert finger_clearance(HAND, (0, 0), yaw, [side], 0.03) > along


def test_walls_of_the_container_are_cleared():
    box = Container()
    near = (box.x, box.y - box.half_side - 0.045)
    assert finger_clearance(HAND, near, 0.0, [], 0.03, box) < 0
    assert finger_clearance(HAND, near, math.pi / 2, [], 0.03, box) > 0.02


@given(st.floats(-math.pi, math.pi))
def test_a_box_is_taken_by_its_narrow_sides_with_the_pads_flat_on_them(yaw):
    target = Target("box", (0.4, 0.0, 0.03), 0.06, (0.1, 0.03), yaw)
    (found,) = yaws_of(target, HAND) or []
    fingers = tool_down(0, 0, 0, found)[:2, 1]
    assert abs(fingers @ [math.cos(yaw), math.sin(yaw)]) < 1e-9, "along its short side"
    assert -math.pi / 2 <= found <= math.pi / 2


def test_cube_has_two_yaws_and_a_too_wide_box_none():
    assert yaws_of(Target("cube", (0.4, 0.0, 0.03), 0.03, (0.04, 0.04), 0.1), HAND) == pytest.approx(
        [0.1, 0.1 - math.pi / 2])
    assert yaws_of(Target("crate", (0.4, 0.0, 0.03), 0.08, (0.1, 0.1)), HAND) == []
    assert yaws_of(Target("ball", (0.4, 0.0, 0.03), 0.03), HAND) is None


def test_hand_has_the_shape_of_the_robot_files_gripper():
    for overrides, shape in (([], (0.04, 0.056, 0.011)),
                             (["robot.gripper.fingers={depth: 0.02, half_width: 0.015}"], (0.04, 0.06, 0.015))):
        hand = service_config(load_cell("panda", overrides), "smart_pick_place", Config).hand
        assert (hand.finger_inner, hand.finger_outer, hand.finger_half_width) == shape


def test_deprecated_shape_parameters_warn():
    cell = load_cell("panda", ["services.smart_pick_place.hand={finger_half_width: 0.02, yaw_count: 4}"])
    with pytest.warns(FutureWarning, match=r"finger_half_width belongs to the robot file: gripper\.fingers\."):
        hand = service_config(cell, "smart_pick_place", Config).hand
    assert (hand.finger_half_width, hand.finger_outer, hand.yaw_count) == (0.02, 0.056, 4)
