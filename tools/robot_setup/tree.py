"""Links and joints of a URDF, which of them form the arm and the fingers, and the limits of joints."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from common.errors import ConfigError, UnknownName
from common.robot.description_values import MOVING
from common.robot.urdf import WORLD

FINGER_WORDS = ("finger", "gripper", "jaw", "knuckle", "claw")
LEAST_JOINTS = 3  # of an arm: a tree that branches earlier has several arms
MOST_JOINTS = 30  # in one chain
MOST_MOVING = 120
FINGER_JOINTS = 3  # longest chain of a finger


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF; `lower`, `upper` [rad or m] and `velocity` [rad/s or m/s] are None if not given.

    `mimic` is the joint that it follows, and the multiplier; `offset` is added to that.
    """

    name: str
    kind: str
    parent: str
    child: str
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    mimic: tuple[str, float] | None = None
    offset: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether the joint is not fixed."""
        return self.kind in MOVING


@dataclass(frozen=True)
class Tree:
    """A URDF: links and joints in the order of the file; `shaped` are links with collision shapes."""

    name: str
    links: list[str]
    joints: list[Joint]
    shaped: frozenset[str]

    @cached_property
    def _by_child(self) -> dict[str, Joint]:
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def root(self) -> str:
        """The link without a parent."""
        return next(link for link in self.links if link not in self._by_child)

    def above(self, link: str) -> list[Joint]:
        """Return the joints between the root and a link, from the root on."""
        found: list[Joint] = []
        while (joint := self._by_child.get(link)) is not None:
            found.append(joint)
            link = joint.parent
        return found[::-1]

    def on(self, link: str) -> list[Joint]:
        """Return the joints that a link carries directly."""
        return [joint for joint in self.joints if joint.parent == link]

    def below(self, link: str) -> list[Joint]:
        """Return all joints beyond a link."""
        found = []
        for joint in self.on(link):
            found += [joint, *self.below(joint.child)]
        return found

    def moving_below(self, link: str) -> list[Joint]:
        """Return the moving joints beyond a link."""
        return [joint for joint in self.below(link) if joint.moves]

    def rigid_with(self, link: str) -> list[str]:
        """Return the link itself and the links that are rigidly connected beyond it."""
        found = [link]
        for joint in self.on(link):
            if not joint.moves:
                found += self.rigid_with(joint.child)
        return found


@dataclass(frozen=True)
class Arm:
    """The part of a tree that is planned for.

    Attributes:
        joints: those of the arm, from the base on.
        base: its first link for the robot file; links above it are dropped.
        wrist: the link that the last joint moves.
        fingers: moving joints beyond the wrist.
    """

    joints: list[Joint]
    base: str
    wrist: str
    fingers: list[Joint]


def read_tree(root: ET.Element, source: str) -> Tree:
    """Return the links and joints of a parsed URDF.

    Raises:
        ConfigError: it is no tree: no link, several roots, a link with two parents, or a cycle; or a joint's link is
            missing.
    """
    links = [link.get("name", "") for link in root.findall("link")]
    joints = [_joint(element, links, source) for element in root.findall("joint")]
    children = [joint.child for joint in joints]
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        raise ConfigError("urdf", source, f"must have one root link, not {', '.join(roots) or 'none'}")
    if twice := sorted({child for child in children if children.count(child) > 1}):
        raise ConfigError("urdf", source, f"has more than one joint that carries {', '.join(twice)}")
    shaped = frozenset(link.get("name", "") for link in root.findall("link") if link.find("collision") is not None)
    tree = Tree(root.get("name", ""), links, joints, shaped)
    held = {roots[0], *(joint.child for joint in tree.below(roots[0]))}
    if loose := [link for link in links if link not in held]:
        raise ConfigError("urdf", source, f"has links that hang on each other, not on {roots[0]}: {', '.join(loose)}")
    longest, moving = max(len(_moving(tree, link)) for link in links), sum(joint.moves for joint in joints)
    if longest > MOST_JOINTS or moving > MOST_MOVING:
        raise ConfigError("urdf", source, f"has {moving} moving joints, {longest} of them in one chain; "
                                          f"at most {MOST_MOVING} and {MOST_JOINTS} are supported")
    return tree


def _joint(element: ET.Element, links: Sequence[str], source: str) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    ends = [found.get("link", "") if (found := element.find(end)) is not None else "" for end in ("parent", "child")]
    for end in ends:
        if end not in links:
            raise ConfigError("urdf", source, f"has a joint {name!r} on a link {end!r}, which is not there")
    limit, mimic = element.find("limit"), element.find("mimic")

    def value(of: ET.Element | None, key: str) -> float | None:
        text = of.get(key) if of is not None else None
        return None if text is None else float(text)

    follows = None
    if mimic is not None:
        factor = value(mimic, "multiplier")
        follows = (mimic.get("joint", ""), 1.0 if factor is None else factor)
    return Joint(name, kind, ends[0], ends[1], value(limit, "lower"), value(limit, "upper"),
                 value(limit, "velocity") or None, follows, value(mimic, "offset") or 0.0)


def find_arm(tree: Tree, source: str, tip: str | None = None, group: Sequence[str] = ()) -> Arm:
    """Return the longest chain of moving joints up to the fingers, the one that carries `tip`, or the joints `group`.

    Raises:
        ConfigError: fewer than three joints move, or none moves `tip`. UnknownName: the link `tip` does not exist.
    """
    if tip is not None and tip not in tree.links:
        raise UnknownName("link", tip, tree.links)
    if group:
        chain = [next(joint for joint in tree.joints if joint.name == name) for name in group]
        return Arm(chain, _base(tree), chain[-1].child, tree.moving_below(chain[-1].child))
    wrists = find_wrists(tree)
    if not wrists:
        raise ConfigError("urdf", source, "has no joint that moves: it is no arm")
    wrist = max(wrists, key=lambda link: len(_moving(tree, link)))
    if tip is not None:
        moving = _moving(tree, tip)
        if not moving:
            raise ConfigError("--tip", tip, f"is moved by no joint; arms end at {', '.join(wrists)}")
        wrist = moving[-1].child
    joints = _moving(tree, wrist)
    if len(joints) < LEAST_JOINTS:
        raise ConfigError("urdf", source, f"has an arm of fewer than {LEAST_JOINTS} moving joints: only "
                                          f"{', '.join(joint.name for joint in joints)} up to link {wrist}")
    return Arm(joints, _base(tree), wrist, tree.moving_below(wrist))


def find_wrists(tree: Tree) -> list[str]:
    """Return the last moved link of each arm: only fingers or nothing move beyond it."""
    found = []
    for joint in tree.joints:
        finger = any(_ends_arm(tree, other.child) for other in _moving(tree, joint.parent))
        if joint.moves and not finger and (_ends_arm(tree, joint.child) or not tree.moving_below(joint.child)):
            found.append(joint.child)
    return found


def _moving(tree: Tree, link: str) -> list[Joint]:
    return [joint for joint in tree.above(link) if joint.moves]


def _ends_arm(tree: Tree, link: str) -> bool:
    """Return whether the moving parts on a link are fingers: several short ones, or one named so."""
    rigid = tree.rigid_with(link)
    moving = [joint for joint in tree.joints if joint.moves and joint.parent in rigid]
    if len(_moving(tree, link)) < LEAST_JOINTS or not moving or max(_depth(tree, j) for j in moving) > FINGER_JOINTS:
        return False
    called, last = (moving[0].name.lower(), moving[0].child.lower()), not tree.moving_below(moving[0].child)
    return len(moving) > 1 or (last and any(word in name for word in FINGER_WORDS for name in called))


def _depth(tree: Tree, joint: Joint) -> int:
    """Return the number of joints in a chain that starts with this one."""
    before = len(_moving(tree, joint.parent))
    return max(len(_moving(tree, other.child)) for other in (joint, *tree.moving_below(joint.child))) - before


def _base(tree: Tree) -> str:
    """Return the root, without links that only fix it in a world, whatever else is fixed there."""
    link = tree.root
    if link == WORLD and (moving := next((joint for joint in tree.below(link) if joint.moves), None)) is not None:
        link = next((joint.child for joint in tree.above(moving.child) if not joint.moves), link)
    while link not in tree.shaped and len(held := tree.on(link)) == 1 and not held[0].moves:
        link = held[0].child
    return link


SPEED = 1.0  # of a joint without one in the URDF [rad/s or m/s]
TO_SPEED = 0.5  # time to the speed limit [s]: acceleration = velocity / 0.5
TO_ACCELERATION = 0.05  # time to the acceleration limit [s]: jerk = acceleration / 0.05
WIDEST = math.pi  # planned range of a joint with more than a full turn: +- this [rad]


def position_range(joint: Joint) -> tuple[float, float, bool]:
    """Return the planned range [rad or m], and whether it is narrower than in the URDF.

    Raises:
        ConfigError: a joint with limits has none in the URDF.
    """
    low, high = joint.lower, joint.upper
    if joint.kind == "continuous":
        return -WIDEST, WIDEST, True
    if low is None or high is None or not low < high:
        raise ConfigError("urdf", joint.name, f"is {joint.kind} and needs limits, lower before upper")
    if joint.kind == "revolute" and high - low > 2 * WIDEST + 1e-3 and low <= -WIDEST and high >= WIDEST:
        return -WIDEST, WIDEST, True
    return low, high, False


def guessed_acceleration(speed: float) -> float:
    """Return the acceleration limit [rad/s^2 or m/s^2] for a speed limit [rad/s or m/s]."""
    return round(speed / TO_SPEED, 3)


def guessed_jerk(acceleration: float) -> float:
    """Return the jerk limit [rad/s^3 or m/s^3] for an acceleration limit."""
    return round(acceleration / TO_ACCELERATION, 2)
