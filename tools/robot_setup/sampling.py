"""Properties of a robot from sampled configurations: a home pose, and pairs of links that need no collision check."""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.ik import controls_full_pose, solve_tool_down_ik
from common.planning.robot_geometry import RobotGeometry, convex_hulls
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel

Array = NDArray[np.float64]

RADII, HEIGHTS = (0.4, 0.5, 0.6, 0.7), (0.2, 0.3, 0.4, 0.5)  # of the tool, in units of the reach with the tool down
LOWER = (0.15, 0.1, 0.06)  # for arms that do not reach those heights, such as SCARA arms
LOW = 0.03  # above the table, in units of the reach of the stretched arm
TURNS = (0.0, math.pi / 2, -math.pi / 2, math.pi, math.pi / 4, -math.pi / 4)  # of the tool [rad]
SEEDS = 6
EVALUATED = 12  # best candidates
TABLE = 0.0  # height of the table in world, which the arm works on [m]
PLACES = [(radius, angle) for radius in (0.45, 0.65, 0.85) for angle in (-0.9, -0.45, 0.0, 0.45, 0.9)]
STEPS = 16  # IK iterations, as in the reach test of a cell


@dataclass(frozen=True)
class Home:
    """Joint positions (dof,) [rad], whether the tool points down, and the share of test positions in reach."""

    positions: Array
    down: bool
    served: float
    hits: list[str]  # colliding pairs of links; empty if a free pose was found


def find_home(robot: RobotModel, geometry: RobotGeometry, given: Array | None = None) -> Home:
    """Return the pose from which most positions in front of the arm are in reach with the tool down.

    Candidates are all collision-free IK solutions with the tool down in front of the base. Those farthest from joint
    limits and with the links high above the table are evaluated. For an arm that cannot point down, the result is the
    middle of its joint ranges, or the best of random poses. A `given` pose with the tool down is the only candidate.
    """
    rng = np.random.default_rng(0)
    middle = (robot.lower + robot.upper) / 2
    neutral = np.clip(np.zeros(robot.dof), robot.lower + 0.15 * (robot.upper - robot.lower),
                   robot.upper - 0.15 * (robot.upper - robot.lower))
    seeds = [neutral, middle, *(rng.uniform(robot.lower, robot.upper) for _ in range(SEEDS))]
    table = TABLE
    reach = down_reach(robot, table)

    def down_at(heights: Sequence[float]) -> Iterator[tuple[float, Array]]:
        for radius, height, turn in itertools.product(RADII, heights, _turns(robot)):
            x, y = place(robot, radius * reach, 0.0)
            for seed in seeds:
                q = solve_tool_down_ik(robot, (x, y, table + height * reach), turn, seed, iterations=60)
                if q is not None and not hits(robot, geometry, q):
                    yield _comfort(robot, q, neutral, table) + height, q

    found = [(0.0, given)] if given is not None else []
    if reach and not found:
        found = list(down_at(HEIGHTS)) or list(down_at(LOWER))
    found.sort(key=lambda each: -each[0])
    best = [(_served(robot, geometry, q, table, reach), value, q) for value, q in _different(found)[:EVALUATED]]
    if best:
        served, _, q = max(best, key=lambda each: each[0] + each[1])
        return Home(q, True, served, [])
    poses = [neutral, middle, *(rng.uniform(robot.lower, robot.upper) for _ in range(200))]
    free = [q for q in poses if not hits(robot, geometry, q)]
    if free[:1]:
        return Home(max(free, key=lambda q: _comfort(robot, q, neutral, table)), False, 0.0, [])
    return Home(neutral, False, 0.0, hits(robot, geometry, neutral))


def _turns(robot: RobotModel) -> tuple[float, ...]:
    """Return yaw angles of the tool [rad]: one suffices for an arm that cannot choose its yaw."""
    return TURNS if controls_full_pose(robot) else TURNS[:1]


def down_reach(robot: RobotModel, table: float) -> float:
    """Return the largest distance from the base axis at which the tool can point down just above a table [m].

    0 if there is none. `table` is the height of the table [m].
    """
    middle = (robot.lower + robot.upper) / 2
    for share in np.arange(1.0, 0.1, -0.05):
        x, y = place(robot, float(share) * robot.reach, 0.0)
        at = x, y, table + 2 * LOW * robot.reach
        if any(solve_tool_down_ik(robot, at, turn, middle, restarts=30, iterations=40) is not None
               for turn in _turns(robot)):
            return float(share) * robot.reach
    return 0.0


def place(robot: RobotModel, radius: float, angle: float) -> tuple[float, float]:
    """Return (x, y) [m] at a radius [m] from the first joint and an angle [rad] from the x axis of world."""
    x, y = robot.foot[:2] + radius * np.array([math.cos(angle), math.sin(angle)])
    return float(x), float(y)


def _comfort(robot: RobotModel, q: Array, neutral: Array, table: float) -> float:
    """Return a score, larger is better: far from joint limits and singularities, near zero, links above the table."""
    margin = float((np.minimum(q - robot.lower, robot.upper - q) / (robot.upper - robot.lower)).min())
    singular = float(np.linalg.svd(robot.jacobian(q), compute_uv=False)[min(robot.dof, 6) - 1])
    heights = _heights(robot, q, table)
    low = min(0.0, float(np.sort(heights)[min(2, len(heights) - 1)]) - 0.02 * robot.reach)
    raised = float(np.mean(heights)) / max(robot.reach, 1e-6)
    away = float(np.abs(q - neutral).max()) / math.pi
    return 2 * min(margin, 0.15) + min(singular, 0.2) + raised / 2 - 0.5 * away + 10 * low


def _different(found: list[tuple[float, Array]]) -> list[tuple[float, Array]]:
    """Return the candidates without those similar to an earlier one."""
    chosen: list[tuple[float, Array]] = []
    for value, q in found:
        if all(float(np.abs(q - other).max()) > 0.3 for _, other in chosen):
            chosen.append((value, q))
    return chosen


def _served(robot: RobotModel, geometry: RobotGeometry, home: Array, table: float, reach: float) -> float:
    """Return the share of test positions that IK reaches from a home pose with all links above the table.

    It is low for a posture that needs the elbow below the table when the tool is low.
    """
    tried = []
    for (radius, angle), height in itertools.product(PLACES, (LOW, 3 * LOW)):
        at = *place(robot, radius * reach, angle), table + height * robot.reach
        found = (solve_tool_down_ik(robot, at, turn, home, iterations=STEPS) for turn in _turns(robot))
        tried.append(any(
            q is not None and not hits(robot, geometry, q)
            and min(_heights(robot, q, table)) > -0.01 for q in found))
    return sum(map(bool, tried)) / len(tried)


def _heights(robot: RobotModel, q: Array, table: float) -> list[float]:
    """Return the heights of the links above a table [m]; for an arm next to it, of those above it."""
    places = [pose[:3, 3] for pose in robot.link_poses(q).values()]
    near = 0.25 * robot.reach if robot.config.base_position[2] < table else 0.0
    return [float(at[2]) - table for at in places
            if float(np.hypot(*(at[:2] - robot.foot[:2]))) >= near] or [0.0]


def hits(robot: RobotModel, geometry: RobotGeometry, q: Array) -> list[str]:
    """Return the colliding pairs of links."""
    data, shapes = robot.model.createData(), pin.GeometryData(geometry.geometry)
    pin.computeCollisions(robot.model, data, geometry.geometry, shapes, q, False)
    pairs = geometry.geometry.collisionPairs
    return list(dict.fromkeys(f"{geometry.links[pair.first]} and {geometry.links[pair.second]}"
                              for pair, result in zip(pairs, shapes.collisionResults, strict=True)
                              if result.isCollision()))


Reason = Literal["Adjacent", "Fixed", "Always", "Hulls", "Never", "Maker"]

ALMOST_ALWAYS = 0.95  # of the samples
OFTEN = 0.5  # of the samples: pairs close to each other that touch more often are reported
NEAR = 2  # joints between two links


@dataclass(frozen=True)
class DisabledPair:
    """Two links that are not checked, and why.

    Adjacent: a joint connects them. Fixed: no joint of the group moves one against the other. Always: they touch at
    every sample; with at most two joints between them, at almost every sample. Hulls: so do their hulls, and their
    shapes at none. Never: they came no closer than the margin at any sample. Maker: listed in the maker's SRDF.
    """

    one: str
    other: str
    reason: Reason


@dataclass(frozen=True)
class Overlap:
    """Two links with at most two joints between them that touch often but not always; shares of the samples.

    Attributes:
        hulls, shapes: share at which their convex hulls, and their shapes, touch; None: not computed.
        reason: why they are not checked; None: they are.
    """

    one: str
    other: str
    hulls: float
    shapes: float | None
    reason: Reason | None

    @property
    def line(self) -> str:
        """What a user should know about the pair."""
        names, as_shapes = f"{self.one} and {self.other}", f", their shapes in {self.shapes or 0:.2%}"
        touch = f"their convex hulls touch in {self.hulls:.2%} of the poses{'' if self.shapes is None else as_shapes}"
        return f"{names} are not checked: {touch}" if self.reason else (
            f"{names} are checked: {touch}; --allow-pair {self.one} {self.other} leaves them out")


def disabled_pairs(
    robot: RobotModel, *, samples: int = 10000, margin: float = 0.005, rng: np.random.Generator | None = None
) -> list[DisabledPair]:
    """Return the pairs of `survey_pairs` that need no check."""
    return survey_pairs(robot, samples=samples, margin=margin, rng=rng)[0]


def survey_pairs(
    robot: RobotModel, *, samples: int = 10000, margin: float = 0.005, rng: np.random.Generator | None = None
) -> tuple[list[DisabledPair], list[Overlap]]:
    """Return pairs of links that need no check, and pairs that often touch, in the order of the description.

    The robot's own SRDF is ignored. A pair whose shapes touch at some samples and not at others stays checked, even if
    their hulls touch at almost all.

    Args:
        robot: the model; its group is sampled uniformly within the limits, its fingers over their widths.
        samples: more of them make it more certain that a pair which never came close never will.
        margin: pairs that come closer than this [m] at some sample are not reported as Never.
        rng: source of the samples; without it they are the same each time.
    """
    geometry = convex_hulls(robot.full_geometry())
    model = robot.full_model
    names = [model.frames[item.parentFrame].name for item in geometry.geometryObjects]
    links = list(dict.fromkeys(names))
    bodies = {name: robot.model.frames[robot.frame(name)].parentJoint for name in links}
    found: dict[tuple[str, str], Reason] = {}
    for i, one in enumerate(links):
        for other in links[i + 1:]:
            if bodies[one] == bodies[other]:
                found[one, other] = "Fixed"
            elif _carrier(robot, other, links) == one or _carrier(robot, one, links) == other:
                found[one, other] = "Adjacent"
    for i, one in enumerate(names):
        for j in range(i + 1, len(names)):
            if one != names[j] and (one, names[j]) not in found:
                geometry.addCollisionPair(pin.CollisionPair(i, j))
    between = [(names[pair.first], names[pair.second]) for pair in geometry.collisionPairs]
    generator = rng if rng is not None else np.random.default_rng(0)
    configurations = sample_configurations(robot, samples, generator)
    close = _hits(model, geometry, configurations, margin)
    columns = {pair: [k for k, other in enumerate(between) if other == pair] for pair in between}
    apart = {pair: _joints_between(robot, *(bodies[link] for link in pair)) for pair in columns}
    suspects = []
    for pair, own in columns.items():
        if not close[:, own].any():
            found[pair] = "Never"
        elif close[:, own].any(axis=1).mean() >= (OFTEN if apart[pair] <= NEAR else 1.0):
            suspects.append(pair)
    hulls = _shares(model, geometry, configurations, suspects)
    doubtful = [pair for pair in suspects if ALMOST_ALWAYS <= hulls[pair] < 1.0 and apart[pair] <= NEAR]
    shapes = _shares(model, robot.full_geometry(), configurations, doubtful) if doubtful else {}
    overlaps = []
    for pair in suspects:
        reason: Reason | None = "Always" if hulls[pair] == 1.0 or shapes.get(pair, 0.0) >= ALMOST_ALWAYS else None
        if pair in shapes and shapes[pair] == 0.0:
            reason = "Hulls"
        if reason:
            found[pair] = reason
        if OFTEN <= hulls[pair] < 1.0 and apart[pair] <= NEAR:
            overlaps.append(Overlap(pair[0], pair[1], hulls[pair], shapes.get(pair), reason))
    return [DisabledPair(one, other, found[one, other])
            for i, one in enumerate(links) for other in links[i + 1:] if (one, other) in found], overlaps


def _joints_between(robot: RobotModel, one: int, other: int) -> float:
    """Return the number of joints between two bodies of the group; inf if none carries the other."""
    lower, upper, count = max(one, other), min(one, other), 0
    while lower > upper:
        lower, count = robot.model.parents[lower], count + 1
    return count if lower == upper else math.inf


def _shares(
    model: pin.Model, geometry: pin.GeometryModel, configurations: Array, pairs: Sequence[tuple[str, str]]
) -> dict[tuple[str, str], float]:
    """Return the share of configurations at which the shapes of each pair of links touch."""
    items: dict[str, list[int]] = {}
    for index, item in enumerate(geometry.geometryObjects):
        items.setdefault(model.frames[item.parentFrame].name, []).append(index)
    geometry.removeAllCollisionPairs()
    columns = {}
    for one, other in pairs:
        own = [pin.CollisionPair(*sorted(both)) for both in itertools.product(items[one], items[other])]
        columns[one, other] = slice(len(geometry.collisionPairs), len(geometry.collisionPairs) + len(own))
        for each in own:
            geometry.addCollisionPair(each)
    touching = _hits(model, geometry, configurations, 0.0)
    return {pair: float(touching[:, own].any(axis=1).mean()) for pair, own in columns.items()}


def sample_configurations(robot: RobotModel, samples: int, rng: np.random.Generator) -> Array:
    """Return random configurations (samples, nq) of the full model: group and gripper vary, the rest is locked."""
    model = robot.full_model
    configurations = np.tile(robot.full_reference, (samples, 1))

    def column(joint: str) -> int:
        return int(model.joints[model.getJointId(joint)].idx_q)

    configurations[:, [column(joint) for joint in robot.joint_names]] = rng.uniform(
        robot.lower, robot.upper, (samples, robot.dof)
    )
    gripper = robot.config.gripper
    if gripper is not None:
        widths = rng.uniform(0.0, gripper.max_width, samples)
        fingers = np.array([finger_positions(gripper, float(width)) for width in widths])
        for values, joint in zip(fingers.T, gripper.joints, strict=True):
            configurations[:, column(joint)] = values
    return configurations


def _carrier(robot: RobotModel, link: str, with_geometry: list[str]) -> str:
    """Return the nearest parent link that has a shape."""
    parent = robot.link_parents.get(link, "")
    while parent and parent not in with_geometry:
        parent = robot.link_parents.get(parent, "")
    return parent


def _hits(model: pin.Model, geometry: pin.GeometryModel, configurations: Array, margin: float) -> NDArray[np.bool_]:
    """Return (N, pairs) whether the shapes of each pair are closer than a margin [m] at each configuration."""
    data, shapes = model.createData(), pin.GeometryData(geometry)
    for request in shapes.collisionRequests:
        request.security_margin = margin
    hits = np.zeros((len(configurations), len(geometry.collisionPairs)), dtype=bool)
    for row, q in zip(hits, configurations, strict=True):
        pin.computeCollisions(model, data, geometry, shapes, q, False)
        row[:] = [result.isCollision() for result in shapes.collisionResults]
    return hits


def srdf(robot: RobotModel, pairs: list[DisabledPair]) -> str:
    """Return an SRDF: groups and named poses of the robot file, and the pairs that are not checked."""
    config = robot.config
    root = ET.Element("robot", name=robot.full_model.name)
    ET.SubElement(root, "virtual_joint", name="base", type="fixed", parent_frame="world", child_link=config.base_link)
    arm = ET.SubElement(root, "group", name=config.group)
    ET.SubElement(arm, "chain", base_link=config.base_link, tip_link=config.tcp_link)
    gripper = config.gripper
    if gripper is not None:
        fingers = ET.SubElement(root, "group", name=gripper.group)
        for joint in gripper.joints:
            ET.SubElement(fingers, "joint", name=joint)
    states = [(name, config.group, config.joints, positions) for name, positions in config.named_poses.items()]
    if gripper is not None:
        states += [(name, gripper.group, gripper.joints, finger_positions(gripper, width))
                   for name, width in gripper.named_widths.items()]
    for name, group, joints, positions in states:
        state = ET.SubElement(root, "group_state", name=name, group=group)
        for joint, position in zip(joints, positions, strict=True):
            ET.SubElement(state, "joint", name=joint, value=f"{round(position, 6) + 0.0:g}")
    for pair in pairs:
        ET.SubElement(root, "disable_collisions", link1=pair.one, link2=pair.other, reason=pair.reason)
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'
