"""Links and joints as a URDF has them, and which of them are the arm and which the fingers."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from common.errors import ConfigError, UnknownName

MOVING = ("revolute", "continuous", "prismatic")
FINGER_WORDS = ("finger", "gripper", "jaw", "knuckle", "claw")
LEAST_JOINTS = 3  # of an arm: what splits up before is a body with several of them
FINGER_JOINTS = 3  # one after the other, at most


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF; `lower`, `upper` [rad or m] and `velocity` [rad/s or m/s] are None where it gives none.

    `mimic` is the joint that it follows, and how many times as far it moves.
    """

    name: str
    kind: str
    parent: str
    child: str
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    mimic: tuple[str, float] | None = None

    @property
    def moves(self) -> bool:
        """Whether it is no fixed one."""
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
        """The link that hangs on none."""
        return next(link for link in self.links if link not in self._by_child)

    def above(self, link: str) -> list[Joint]:
        """Joints between the root and a link, from the root on."""
        found: list[Joint] = []
        while (joint := self._by_child.get(link)) is not None:
            found.append(joint)
            link = joint.parent
        return found[::-1]

    def on(self, link: str) -> list[Joint]:
        """Joints that a link carries itself."""
        return [joint for joint in self.joints if joint.parent == link]

    def below(self, link: str) -> list[Joint]:
        """All joints beyond a link, whatever lies between."""
        found = []
        for joint in self.on(link):
            found += [joint, *self.below(joint.child)]
        return found

    def moving_below(self, link: str) -> list[Joint]:
        """Those of them that move."""
        return [joint for joint in self.below(link) if joint.moves]

    def rigid_with(self, link: str) -> list[str]:
        """Links beyond a link that no joint moves against it, and itself, which comes first."""
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
        base: its first link, as a robot file wants it: all that is above is dropped.
        wrist: the link that the last joint moves.
        fingers: joints beyond the wrist that move, without those that stand still.
    """

    joints: list[Joint]
    base: str
    wrist: str
    fingers: list[Joint]


def read_tree(root: ET.Element, source: str) -> Tree:
    """The links and joints of a URDF that was parsed.

    Raises:
        ConfigError: it is no tree: without links or with several roots, with a link on two joints, or with links that
            hang on each other; or a joint is not whole.
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
        try:
            number = None if text is None else float(text)
        except ValueError:
            number = math.nan
        if number is not None and not math.isfinite(number):
            raise ConfigError("urdf", source, f"has a joint {name!r} whose {key} is {text!r}, no number")
        return number

    axis = element.find("axis")
    if kind in MOVING and axis is not None and not any(map(_may_turn, axis.get("xyz", "1 0 0").split())):
        raise ConfigError("urdf", source, f"has a joint {name!r} whose axis is {axis.get('xyz')!r}, which is none")
    missing = next((key for key in ("effort", "velocity") if limit is not None and limit.get(key) is None), None)
    if missing is not None and kind in MOVING:
        raise ConfigError("urdf", source, f"has a joint {name!r} whose limit has no {missing}, which a URDF must give")
    follows = None
    if mimic is not None:
        factor = value(mimic, "multiplier")
        follows = (mimic.get("joint", ""), 1.0 if factor is None else factor)
    return Joint(name, kind, ends[0], ends[1], value(limit, "lower"), value(limit, "upper"),
                 value(limit, "velocity") or None, follows)


def _may_turn(text: str) -> bool:
    """Whether a number of an axis is not 0; whoever loads the URDF says what is none."""
    try:
        return float(text) != 0
    except ValueError:
        return True


def find_arm(tree: Tree, source: str, tip: str | None = None) -> Arm:
    """The longest series of moving joints that ends where fingers begin, or that which carries `tip`.

    Raises:
        ConfigError: no joint moves, or none moves `tip`. UnknownName: there is no link `tip`.
    """
    if tip is not None and tip not in tree.links:
        raise UnknownName("link", tip, tree.links)
    wrists = find_wrists(tree)
    if not wrists:
        raise ConfigError("urdf", source, "has no joint that moves: it is no arm")
    wrist = max(wrists, key=lambda link: len(_moving(tree, link)))
    if tip is not None:
        moving = _moving(tree, tip)
        if not moving:
            raise ConfigError("--tip", tip, f"is moved by no joint; arms end at {', '.join(wrists)}")
        wrist = moving[-1].child
    return Arm(_moving(tree, wrist), _base(tree), wrist, tree.moving_below(wrist))


def find_wrists(tree: Tree) -> list[str]:
    """The last link of each arm that a joint moves: what moves beyond it are fingers, or nothing does."""
    found = []
    for joint in tree.joints:
        finger = any(_ends_arm(tree, other.child) for other in _moving(tree, joint.parent))
        if joint.moves and not finger and (_ends_arm(tree, joint.child) or not tree.moving_below(joint.child)):
            found.append(joint.child)
    return found


def _moving(tree: Tree, link: str) -> list[Joint]:
    return [joint for joint in tree.above(link) if joint.moves]


def _ends_arm(tree: Tree, link: str) -> bool:
    """Whether what moves on a link are fingers: short and several, or one that is called so."""
    rigid = tree.rigid_with(link)
    moving = [joint for joint in tree.joints if joint.moves and joint.parent in rigid]
    if len(_moving(tree, link)) < LEAST_JOINTS or not moving or max(_depth(tree, j) for j in moving) > FINGER_JOINTS:
        return False
    called, last = (moving[0].name.lower(), moving[0].child.lower()), not tree.moving_below(moving[0].child)
    return len(moving) > 1 or (last and any(word in name for word in FINGER_WORDS for name in called))


def _depth(tree: Tree, joint: Joint) -> int:
    """How many joints a finger has one after the other, this the first."""
    return 1 + max((_depth(tree, other) for other in tree.moving_below(joint.child)), default=0)


def _base(tree: Tree) -> str:
    """The root; what only holds it in a world is left out."""
    link = tree.root
    while link not in tree.shaped and len(held := tree.on(link)) == 1 and not held[0].moves:
        link = held[0].child
    return link


SPEED = 1.0  # of a joint whose URDF gives none [rad/s or m/s]
TO_SPEED = 0.5  # a joint takes so long to its speed limit [s]: acceleration = velocity / 0.5
TO_ACCELERATION = 0.05  # and so long to its acceleration limit [s]: jerk = acceleration / 0.05
WIDEST = math.pi  # a joint that turns on and on, or farther than a full turn, is planned for within +- this [rad]


def position_range(joint: Joint) -> tuple[float, float, bool]:
    """Lowest and highest position [rad or m] that is planned for, and whether the URDF says otherwise.

    Raises:
        ConfigError: a joint that has ends says not where.
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
    """[rad/s^2 or m/s^2] of a joint with such a speed limit [rad/s or m/s]."""
    return round(speed / TO_SPEED, 3)


def guessed_jerk(acceleration: float) -> float:
    """[rad/s^3 or m/s^3] of a joint with such an acceleration limit."""
    return round(acceleration / TO_ACCELERATION, 2)
