"""Which joints of a URDF are the arm, and which the fingers."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from common.errors import ConfigError, UnknownName
from tools.robot_setup.tree import Tree, find_arm, find_wrists, read_tree


def chain(*joints: str) -> Tree:
    """A tree of `parent>child` (fixed), `parent-child` (it turns), `parent=child` (it slides)."""
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


def test_two_joints_on_the_hand_are_fingers_also_behind_fixed_links() -> None:
    arm = find_arm(chain(*ARM, "d>hand", "hand=left", "hand>mount", "mount=right"), "f")
    assert (arm.wrist, [joint.child for joint in arm.fingers]) == ("d", ["left", "right"])


def test_a_last_joint_is_a_finger_only_when_it_is_called_so() -> None:
    assert find_arm(chain(*ARM, "d-tool"), "f").wrist == "tool"
    assert find_arm(chain(*ARM, "d-gripper_jaw"), "f").wrist == "d"
    assert find_arm(chain(*ARM, "d-gripper_link", "gripper_link-moving_jaw"), "f").wrist == "gripper_link"


def test_of_two_arms_on_a_body_the_longer_is_taken_or_the_one_that_is_named() -> None:
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


def test_what_is_no_arm_is_told() -> None:
    with pytest.raises(ConfigError, match="no joint that moves"):
        find_arm(chain("base>a"), "f")
    with pytest.raises(ConfigError, match="'base' is moved by no joint"):
        find_arm(chain(*ARM), "f", "base")
    with pytest.raises(UnknownName, match="choices: a, b"):
        find_arm(chain(*ARM), "f", "z")


def test_a_urdf_with_two_roots_is_told() -> None:
    with pytest.raises(ConfigError, match="one root link, not a, c"):
        chain("a-b", "c-d")


def test_a_urdf_that_is_no_tree_is_told() -> None:
    with pytest.raises(ConfigError, match="more than one joint that carries c"):
        chain("base-a", "base-b", "a-c", "b-c")
    with pytest.raises(ConfigError, match="hang on each other, not on base: b, c"):
        chain("base-a", "b-c", "c-b")


@pytest.mark.parametrize("axis", ["0 0 0", "0 -0.0 0.0"])
def test_joint_about_no_axis_is_told(axis: str) -> None:
    text = ('<robot><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
            f'<axis xyz="{axis}"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>')
    with pytest.raises(ConfigError, match=f"'j' whose axis is '{axis}', which is none"):
        read_tree(ET.fromstring(text), "f")
    assert read_tree(ET.fromstring(text.replace(axis, "0 0 1")), "f").joints
