"""Arm, fingers and joint limits of a URDF."""

import math
import xml.etree.ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import ConfigError, UnknownName
from tools.robot_setup.tree import (
    Joint,
    Tree,
    find_arm,
    find_wrists,
    guessed_acceleration,
    guessed_jerk,
    position_range,
    read_tree,
)

LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def chain(*joints: str) -> Tree:
    """Return a tree of `parent>child` (fixed), `parent-child` (revolute) and `parent=child` (prismatic) joints."""
    kinds = {">": "fixed", "-": "revolute", "=": "prismatic"}
    text, links = "", dict[str, None]()
    for joint in joints:
        mark = next(mark for mark in kinds if mark in joint)
        parent, child = joint.split(mark)
        links |= {parent: None, child: None}
        text += (f'<joint name="{parent}_{child}" type="{kinds[mark]}"><parent link="{parent}"/><child link="{child}"/>'
                 f'{LIMIT}</joint>')
    shape = "<collision><geometry><sphere radius='0.1'/></geometry></collision>"
    shaped = "".join(f'<link name="{name}">{shape}</link>' for name in links)
    return read_tree(ET.fromstring(f"<robot>{shaped}{text}</robot>"), "f")


ARM = ("base-a", "a-b", "b-c", "c-d")


@pytest.mark.parametrize(("more", "wrist", "fingers"), [
    (("d>hand", "hand=left", "hand>mount", "mount=right"), "d", ["left", "right"]),
    (("d-tool",), "tool", []), (("d-gripper_jaw",), "d", ["gripper_jaw"]),
    (("d-gripper_link", "gripper_link-moving_jaw"), "gripper_link", ["moving_jaw"]),
])
def test_two_last_joints_are_fingers_and_a_single_one_by_its_name(more, wrist, fingers):
    arm = find_arm(chain(*ARM, *more), "f")
    assert (arm.wrist, [joint.child for joint in arm.fingers]) == (wrist, fingers)


def test_longer_or_named_arm_is_selected_also_on_a_torso():
    left, right = (tuple(f"{side}{k}-{side}{k + 1}" for k in range(count)) for side, count in (("l", 5), ("r", 4)))
    body = chain("base>l0", "base>r0", *left, *right)
    assert find_wrists(body) == ["l5", "r4"]
    assert find_arm(body, "f").wrist == "l5"
    assert [joint.child for joint in find_arm(body, "f", "r4").joints] == ["r1", "r2", "r3", "r4"]
    assert find_wrists(chain("base-a", "a-b", "b-c", "c>l0", "c>r0", *left, *right, "r4-r5")) == ["l5", "r5"]


@pytest.mark.parametrize(("joints", "tip", "problem"), [
    (("base>a",), None, "no joint that moves"), (("base-a", "a-b"), None, "fewer than 3 moving joints: only base_a, a"),
    (ARM, "base", "'base' is moved by no joint"),
    (ARM, "z", "choices: a, b"), (("a-b", "c-d"), None, "one root link, not a, c"),
    (("base-a", "base-b", "a-c", "b-c"), None, "more than one joint that carries c"),
    (("base-a", "b-c", "c-b"), None, "hang on each other, not on base: b, c"),
])
def test_urdf_without_an_arm_or_tree_is_rejected(joints, tip, problem):
    with pytest.raises((ConfigError, UnknownName), match=problem):
        find_arm(chain(*joints), "f", tip)


@given(st.floats(0.05, 20))
def test_guessed_limits_take_half_a_second_to_full_speed_and_a_twentieth_to_full_acceleration(speed):
    acceleration = guessed_acceleration(speed)
    assert speed / acceleration == pytest.approx(0.5, rel=0.01)
    assert acceleration / guessed_jerk(acceleration) == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize(("kind", "low", "high", "found"), [
    ("continuous", None, None, (-math.pi, math.pi, True)), ("continuous", -6.3, 6.3, (-math.pi, math.pi, True)),
    ("revolute", -2 * math.pi, 2 * math.pi, (-math.pi, math.pi, True)),
    ("revolute", -math.pi, math.pi, (-math.pi, math.pi, False)), ("revolute", 0.3, 6.0, (0.3, 6.0, False)),
    ("revolute", -0.1, 7.0, (-0.1, 7.0, False)), ("prismatic", 0.0, 9.0, (0.0, 9.0, False)),
])
def test_limits_are_those_of_the_urdf_or_half_a_turn_either_way(kind, low, high, found):
    assert position_range(Joint("j", kind, "a", "b", low, high)) == found


@pytest.mark.parametrize(("low", "high"), [(None, None), (0.0, 0.0), (1.0, -1.0), (None, 1.0)])
def test_joint_without_limits_is_rejected(low, high):
    with pytest.raises(ConfigError, match="'j' is revolute and needs limits"):
        position_range(Joint("j", "revolute", "a", "b", low, high))
