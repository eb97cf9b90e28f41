"""Arm, fingers and joint limits of a URDF."""

from __future__ import annotations

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


def chain(*joints: str) -> Tree:
    """Tree of `parent>child` (fixed), `parent-child` (revolute) and `parent=child` (prismatic) joints."""
    kinds = {">": "fixed", "-": "revolute", "=": "prismatic"}
    text, links = "", dict[str, None]()
    for joint in joints:
        mark = next(mark for mark in kinds if mark in joint)
        parent, child = joint.split(mark)
        links |= {parent: None, child: None}
        text += (f'<joint name="{parent}_{child}" type="{kinds[mark]}"><parent link="{parent}"/><child link="{child}"/>'
                 '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>')
    shape = "<collision><geometry><sphere radius='0.1'/></geometry></collision>"
    shaped = "".join(f'<link name="{name}">{shape}</link>' for name in links)
    return read_tree(ET.fromstring(f"<robot>{shaped}{text}</robot>"), "f")


ARM = ("base-a", "a-b", "b-c", "c-d")


def test_two_joints_at_the_end_are_fingers_also_behind_fixed_links() -> None:
    arm = find_arm(chain(*ARM, "d>hand", "hand=left", "hand>mount", "mount=right"), "f")
    assert (arm.wrist, [joint.child for joint in arm.fingers]) == ("d", ["left", "right"])


def test_single_last_joint_is_a_finger_only_by_its_name() -> None:
    assert find_arm(chain(*ARM, "d-tool"), "f").wrist == "tool"
    assert find_arm(chain(*ARM, "d-gripper_jaw"), "f").wrist == "d"
    assert find_arm(chain(*ARM, "d-gripper_link", "gripper_link-moving_jaw"), "f").wrist == "gripper_link"


def test_of_two_arms_the_longer_or_the_named_one_is_selected() -> None:
    left = tuple(f"l{k}-l{k + 1}" for k in range(5))
    right = tuple(f"r{k}-r{k + 1}" for k in range(4))
    body = chain("base>l0", "base>r0", *left, *right)
    assert find_wrists(body) == ["l5", "r4"]
    assert find_arm(body, "f").wrist == "l5"
    assert [joint.child for joint in find_arm(body, "f", "r4").joints] == ["r1", "r2", "r3", "r4"]


def test_arms_on_a_torso_are_no_fingers() -> None:
    arms = [f"{side}{k}-{side}{k + 1}" for side in "lr" for k in range(5)]
    body = chain("base-a", "a-b", "b-c", "c>l0", "c>r0", *arms)
    assert find_wrists(body) == ["l5", "r5"]


def test_urdf_without_an_arm_is_rejected() -> None:
    with pytest.raises(ConfigError, match="no joint that moves"):
        find_arm(chain("base>a"), "f")
    with pytest.raises(ConfigError, match="'base' is moved by no joint"):
        find_arm(chain(*ARM), "f", "base")
    with pytest.raises(UnknownName, match="choices: a, b"):
        find_arm(chain(*ARM), "f", "z")


@pytest.mark.parametrize(("joints", "problem"), [
    (("a-b", "c-d"), "one root link, not a, c"),
    (("base-a", "base-b", "a-c", "b-c"), "more than one joint that carries c"),
    (("base-a", "b-c", "c-b"), "hang on each other, not on base: b, c"),
])
def test_urdf_that_is_no_tree_is_rejected(joints: tuple[str, ...], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        chain(*joints)


@pytest.mark.parametrize("axis", ["0 0 0", "0 -0.0 0.0"])
def test_joint_without_an_axis_is_rejected(axis: str) -> None:
    text = ('<robot><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
            f'<axis xyz="{axis}"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>')
    with pytest.raises(ConfigError, match=f"'j' whose axis is '{axis}', which is none"):
        read_tree(ET.fromstring(text), "f")
    assert read_tree(ET.fromstring(text.replace(axis, "0 0 1")), "f").joints


# --- limits ----------------------------------------------------------------------------------------------------------


def joint(kind: str, lower: float | None = None, upper: float | None = None) -> Joint:
    return Joint("j", kind, "a", "b", lower, upper)


@given(st.floats(0.05, 20))
def test_guessed_limits_take_half_a_second_to_full_speed_and_a_twentieth_to_full_acceleration(speed: float) -> None:
    acceleration = guessed_acceleration(speed)
    assert speed / acceleration == pytest.approx(0.5, rel=0.01)
    assert acceleration / guessed_jerk(acceleration) == pytest.approx(0.05, rel=0.01)


def test_continuous_joint_is_limited_to_half_a_turn_either_way() -> None:
    assert position_range(joint("continuous")) == (-math.pi, math.pi, True)
    assert position_range(joint("continuous", -6.3, 6.3)) == (-math.pi, math.pi, True)
    assert position_range(joint("revolute", -2 * math.pi, 2 * math.pi)) == (-math.pi, math.pi, True)


@pytest.mark.parametrize(("kind", "low", "high"), [
    ("revolute", -math.pi, math.pi), ("revolute", 0.3, 6.0), ("revolute", -0.1, 7.0), ("prismatic", 0.0, 9.0)])
def test_other_limits_are_those_of_the_urdf(kind: str, low: float, high: float) -> None:
    assert position_range(joint(kind, low, high)) == (low, high, False)


@pytest.mark.parametrize(("low", "high"), [(None, None), (0.0, 0.0), (1.0, -1.0), (None, 1.0)])
def test_joint_without_limits_is_rejected(low: float | None, high: float | None) -> None:
    with pytest.raises(ConfigError, match="'j' is revolute and needs limits"):
        position_range(joint("revolute", low, high))
