"""Measures fingers on the model: closing direction, approach direction and widths, of pairs and of turning jaws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.robot_geometry import convex_hulls, shape_corners
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel
from common.robot.transforms import invert

Array = NDArray[np.float64]

TIP = 0.02  # length of a finger tip, which presses on objects [m]
VAGUE = 0.01  # [m] from the start of fingers to their middle: too short to show their direction
PARALLEL = 0.03  # largest rotation of parallel pads while they close [rad]
ALIGNED = math.cos(math.radians(10))


@dataclass(frozen=True)
class Grip:
    """Motion of two fingers in the frame of a link that carries both; all but the axes in [m].

    Attributes:
        pads: end links; the first is farther along `closing`.
        closing: (3,) unit axis of closing; approach: (3,) from the start of the fingers to their tips.
        middle: (3,) between the closed pads, at the height of the tips.
        widths: between the pads at each requested position.
        heights: of the tips along `approach` at each of them.
        turned: largest rotation of a pad [rad].
        depth: of a tip along `closing`; half_width: half its size across.
    """

    pads: tuple[str, str]
    closing: Array
    approach: Array
    middle: Array
    widths: list[float]
    turned: float
    depth: float
    half_width: float
    heights: list[float] = field(default_factory=list)


def link_points(robot: RobotModel) -> dict[str, Array]:
    """Return corners (N, 3) [m] of the collision shapes of each link in its own frame.

    Raises:
        ConfigError: a mesh does not exist.
    """
    found: dict[str, list[Array]] = {}
    for item in convex_hulls(robot.full_geometry()).geometryObjects:
        frame = robot.full_model.frames[item.parentFrame]
        T_link_shape = frame.placement.actInv(item.placement)
        if hasattr(item.geometry, "points"):
            own = np.array(item.geometry.points())
            points = own @ np.array(T_link_shape.rotation).T + np.array(T_link_shape.translation)
        else:
            points = shape_corners(item.geometry, T_link_shape)
        found.setdefault(frame.name, []).append(points)
    return {link: np.vstack(points) for link, points in found.items()}


def measure(
    robot: RobotModel, carrier: str, links: Sequence[str], joints: Sequence[str],
    positions: Sequence[Sequence[float]], points: dict[str, Array],
) -> Grip | None:
    """Measure the fingers from the first joint positions (closed) to the last (open).

    Args:
        robot: the model.
        carrier: a link that carries all of them.
        links: moved by the joints.
        joints: of the fingers.
        positions: of those joints, in their order [rad or m]; at least two.
        points: result of `link_points`.

    Returns:
        None if no two links with shapes move against each other.
    """
    q = np.clip(np.zeros(robot.dof), robot.lower, robot.upper)
    fingers = _Fingers(carrier, points, [robot.link_poses(q, dict(zip(joints, row, strict=True))) for row in positions])
    shaped = [link for link in links if link in points]
    if not shaped:
        return None
    first = [link for link in links if robot.link_parents.get(link) not in links]
    start = np.mean([fingers.placed(link, 0)[:3, 3] for link in first], axis=0)
    chosen = fingers.pads(shaped, start)
    if chosen is None:
        return None
    one, other, closing = chosen
    along = (fingers.cloud(one, 0).mean(axis=0) + fingers.cloud(other, 0).mean(axis=0)) / 2 - start
    approach = _flat(along, closing)
    if np.linalg.norm(approach) < VAGUE:  # the fingers surround their frames: they point away from the arm
        robot.fk(q)
        T_carrier_world, wrist = invert(fingers.seen[0][carrier]), robot.data.oMi[robot.dof].translation
        approach = _flat(along + start - (T_carrier_world[:3, :3] @ wrist + T_carrier_world[:3, 3]), closing)
    if np.linalg.norm(approach) < 1e-3:
        return None
    approach = _flat(_tool_axis(robot, q, fingers.seen[0][carrier], approach), closing)
    return fingers.grip(one, other, closing, _unit(approach))


@dataclass(frozen=True)
class _Fingers:
    """Finger links in the frame of their carrier; `seen` has the poses of all links at each position of the fingers."""

    carrier: str
    points: dict[str, Array]
    seen: list[dict[str, Array]]

    def placed(self, link: str, at: int) -> Array:
        return invert(self.seen[at][self.carrier]) @ self.seen[at][link]

    def cloud(self, link: str, at: int) -> Array:
        return _placed(self.seen[at][self.carrier], self.seen[at][link], self.points[link])

    def pads(self, links: Sequence[str], start: Array) -> tuple[str, str, Array] | None:
        """Return two end links that move against each other and the unit axis of closing; None if there are none."""
        moved = {link: self.cloud(link, -1).mean(axis=0) - self.cloud(link, 0).mean(axis=0) for link in links}
        reach = {link: float(np.linalg.norm(self.cloud(link, 0) - start, axis=1).max()) for link in links}
        one = max(links, key=lambda link: (round(reach[link], 3), float(np.linalg.norm(moved[link]))))
        against = [link for link in links if moved[link] @ moved[one] < -1e-9]
        if not against:
            return None
        other = max(against, key=lambda link: reach[link])
        return one, other, _unit(moved[one] - moved[other])

    def grip(self, one: str, other: str, closing: Array, approach: Array) -> Grip:
        """Measure the tips of two pads."""

        def ends(link: str, at: int, axis: Array) -> tuple[float, float]:
            own = self.cloud(link, at)
            heights = own @ approach
            values = own[heights > heights.max() - TIP] @ axis
            return float(values.min()), float(values.max())

        across, count = np.cross(closing, approach), len(self.seen)
        sides = ends(one, 0, across)
        low, high = ends(one, 0, closing)
        inner = (low + ends(other, 0, closing)[1]) / 2
        height = max(float((self.cloud(link, 0) @ approach).max()) for link in (one, other))
        turns = [self.placed(one, 0)[:3, :3].T @ self.placed(one, at)[:3, :3] for at in range(count)]
        return Grip(
            pads=(one, other), closing=closing, approach=approach,
            middle=inner * closing + sum(sides) / 2 * across + height * approach,
            widths=[ends(one, at, closing)[0] - ends(other, at, closing)[1] for at in range(count)],
            turned=max(math.acos(min(1.0, max(-1.0, (np.trace(R) - 1) / 2))) for R in turns),
            depth=high - low, half_width=(sides[1] - sides[0]) / 2,
            heights=[max(float((self.cloud(link, at) @ approach).max()) for link in (one, other))
                     for at in range(count)],
        )


def _unit(vector: Array) -> Array:
    """Return the unit vector, snapped to a coordinate axis if it is close to one."""
    unit = vector / np.linalg.norm(vector)
    nearest = int(np.argmax(np.abs(unit)))
    if abs(unit[nearest]) > ALIGNED:
        unit = np.eye(3)[nearest] * np.sign(unit[nearest])
    return np.asarray(unit)


def links_moved(robot: RobotModel, joints: Sequence[str]) -> list[str]:
    """Return the links that any of the joints moves."""
    model = robot.full_model
    ids = {model.getJointId(name) for name in joints}
    return [link for link in robot.link_parents if ids & set(model.supports[_joint_of(model, link)])]


def _joint_of(model: pin.Model, link: str) -> int:
    return int(model.frames[model.getFrameId(link, pin.FrameType.BODY)].parentJoint)


def check_tool_frame(robot: RobotModel, points: dict[str, Array] | None = None) -> list[str]:
    """Return deviations of the tool frame from the platform's conventions, one line each.

    The z axis of the tool centre point must point from the palm to the finger tips. The fingers must close along
    `gripper.closing_axis` and open to `gripper.max_width`.
    """
    gripper = robot.config.gripper
    if gripper is None or not gripper.joints:
        return []
    name, axis = robot.config.tcp_link, gripper.closing_axis
    widths = (0.0, gripper.max_width)
    found = measure(robot, name, links_moved(robot, gripper.joints), gripper.joints,
                    [finger_positions(gripper, width) for width in widths], points or link_points(robot))
    if found is None:
        return [f"gripper.joints: no two links that {', '.join(gripper.joints)} move approach each other"]
    opening = gripper.max_width - (gripper.travel[0][0] if gripper.travel else 0.0)  # what the fingers move apart
    problems = []
    if abs(found.closing["xy".index(axis)]) < ALIGNED:
        way = axis_name(found.closing).removeprefix("-")
        problems.append(f"gripper.closing_axis: the fingers close along {way} of {name}, not along {axis}")
    if found.approach[2] < ALIGNED:
        problems.append(f"tcp_link: z of {name} must point from the palm to the tips of the fingers, which is "
                          f"{axis_name(found.approach)}")
    elif abs(found.widths[1] - found.widths[0] - opening) > 0.1 * gripper.max_width:
        problems.append(f"gripper.max_width: the fingers open by {found.widths[1] - found.widths[0]:.4f} m, not by "
                          f"{gripper.max_width:g} m")
    return problems


def axis_name(axis: Array) -> str:
    """Return an axis as text: x, -z, or its numbers."""
    nearest = int(np.argmax(np.abs(axis)))
    if abs(axis[nearest]) > 0.999:
        return f"{'-' if axis[nearest] < 0 else ''}{'xyz'[nearest]}"
    return f"({', '.join(f'{value:.2f}' for value in axis)})"


ALONG = math.cos(math.radians(35))  # largest angle between last joint axis and tip direction for a tool axis
DROP = 0.012  # largest retreat of the jaw's tip while it opens [m]
CLOSED = 0.05  # tolerance between configured and measured closed position [rad]
APART = 0.03  # largest gap between closed tips of a gripper [m]


@dataclass(frozen=True)
class Jaw:
    """Motion of a jaw, see `common.config.TurningJaw`; `grip` is in the frame of the link that carries it."""

    carrier: str
    radius: float
    angle: float
    closed: float
    opens: int
    max_width: float
    grip: Grip


def measure_jaw(robot: RobotModel, joint: str, points: dict[str, Array]) -> Jaw | str:
    """Return the jaw that a joint turns, or why there is none.

    The jaw is closed at the joint limit where its tip is nearer to the fixed finger. The middle of the grip is half the
    width from the fixed finger. Closing moves one jaw only, so that at the end the jaw moves the object against the
    fixed finger, or the gripper moves.

    Args:
        robot: the model.
        joint: of the jaw.
        points: result of `link_points`.
    """
    model = robot.full_model
    index = model.joints[model.getJointId(joint)].idx_q
    ends = float(model.lowerPositionLimit[index]), float(model.upperPositionLimit[index])
    moved = links_moved(robot, [joint])
    carrier = robot.link_parents[next(link for link in moved if robot.link_parents[link] not in moved)]
    shaped = [link for link in moved if link in points]
    fixed = [link for link in points if link not in moved and _joint_of(model, link) == _joint_of(model, carrier)]
    if not shaped or not fixed:
        return f"{joint} has no shape, or nothing fixed has one that it would close against"
    q = np.clip(np.zeros(robot.dof), robot.lower, robot.upper)
    seen = {at: robot.link_poses(q, {joint: at}) for at in ends}
    jaws = {at: np.vstack([_placed(poses[carrier], poses[link], points[link]) for link in shaped])
            for at, poses in seen.items()}
    poses = seen[ends[0]]
    still = np.vstack([_placed(poses[carrier], poses[link], points[link]) for link in fixed])
    first = next(link for link in moved if robot.link_parents[link] not in moved)
    T = {at: invert(seen[at][carrier]) @ seen[at][first] for at in ends}
    turn = pin.log3(T[ends[1]][:3, :3] @ T[ends[0]][:3, :3].T)
    swing = _Swing(T[ends[0]][:3, 3], turn / np.linalg.norm(turn))
    closed, opened = sorted(ends, key=lambda at: swing.gap(jaws[at], still))
    if swing.gap(jaws[closed], still) > APART:
        return f"the jaw of {joint} does not reach the fixed finger: the gap is more than {1e3 * APART:.0f} mm"
    out = _flat(swing.farthest(jaws[closed]) - swing.pivot, swing.axis)
    approach = _tool_axis(robot, q, seen[closed][carrier], out)
    return _jaw_of(swing, (shaped[0], carrier), approach, (closed, jaws[closed]), (opened, jaws[opened]))


@dataclass(frozen=True)
class _Swing:
    """The axis of a jaw in the frame of its carrier: a point (3,) and a unit vector (3,)."""

    pivot: Array
    axis: Array

    def distances(self, cloud: Array) -> Array:
        """Return the distances of points from the axis (N,)."""
        away = cloud - self.pivot
        return np.asarray(np.linalg.norm(away - np.outer(away @ self.axis, self.axis), axis=1))

    def farthest(self, cloud: Array) -> Array:
        return np.asarray(cloud[int(np.argmax(self.distances(cloud)))])

    def gap(self, jaw: Array, finger: Array) -> float:
        """Return the gap between the tips of jaw and finger, seen along the axis [m]."""
        one, other = (cloud[(far := self.distances(cloud)) > far.max() - TIP] for cloud in (jaw, finger))
        ways = (one[:, None] - other[None]).reshape(-1, 3)
        return float(np.linalg.norm(ways - np.outer(ways @ self.axis, self.axis), axis=1).min())


def _jaw_of(
    swing: _Swing, pads: tuple[str, str], approach: Array, closed: tuple[float, Array], opened: tuple[float, Array],
) -> Jaw:
    """Return the jaw of two pads, from its joint position and points (N, 3) when it is closed and open."""
    points = closed[1]
    closing = np.cross(approach, swing.axis)  # the sign follows
    if (swing.farthest(opened[1]) - swing.farthest(points)) @ closing < 0:
        closing = -closing
    tip = points[points @ approach > (points @ approach).max() - TIP]
    inner = tip[int(np.argmin(tip @ closing))]
    along, out = float((inner - swing.pivot) @ approach), float((inner - swing.pivot) @ closing)
    radius, angle = math.hypot(along, out), math.atan2(out, along)
    most = min(abs(opened[0] - closed[0]), math.acos(max(0.0, math.cos(angle) - DROP / radius)) - angle)
    width = radius * (math.sin(angle + most) - math.sin(angle))
    across = np.cross(closing, approach)
    sides, faces = tip @ across, tip @ closing
    height = float((tip @ approach).max())
    middle = (float(inner @ closing) + width / 2) * closing + float(sides.max() + sides.min()) / 2 * across
    grip = Grip(pads=pads, closing=closing, approach=approach, middle=middle + height * approach,
                widths=[0.0, width], turned=most, depth=float(faces.max() - faces.min()),
                half_width=float(sides.max() - sides.min()) / 2)
    return Jaw(pads[1], round(radius, 5), round(angle, 5), round(closed[0], 5), 1 if opened[0] > closed[0] else -1,
               round(width - 5e-5, 4), grip)


def check_jaw(robot: RobotModel, points: dict[str, Array] | None = None) -> list[str]:
    """Return deviations like `check_tool_frame`, for a robot with a jaw."""
    gripper = robot.config.gripper
    assert gripper is not None and gripper.jaw is not None
    found = measure_jaw(robot, gripper.joints[0], points or link_points(robot))
    if isinstance(found, str):
        return [f"gripper.joints: {found}"]
    name, axis, given = robot.config.tcp_link, gripper.closing_axis, gripper.jaw
    poses = robot.link_poses(np.clip(np.zeros(robot.dof), robot.lower, robot.upper))
    R = invert(poses[name])[:3, :3] @ poses[found.carrier][:3, :3]
    closing, approach = R @ found.grip.closing, R @ found.grip.approach
    problems = []
    if abs(closing["xy".index(axis)]) < ALIGNED:
        way = axis_name(closing).removeprefix("-")
        problems.append(f"gripper.closing_axis: the jaw closes along {way} of {name}, not along {axis}")
    if approach[2] < ALIGNED:
        problems.append(f"tcp_link: z of {name} must point from the palm to the tips of the jaws, which is "
                          f"{axis_name(approach)}")
    if given.opens != found.opens or abs(given.closed - found.closed) > CLOSED:
        problems.append(f"gripper.jaw: it is closed at {found.closed:g} and opens by {found.opens:+d}, not at "
                          f"{given.closed:g} and by {given.opens:+d}")
    elif abs(given.radius - found.radius) > 0.1 * found.radius:
        problems.append(f"gripper.jaw.radius: its tip is {found.radius:.4f} m from its axis, not {given.radius:g} m")
    return problems


def _placed(T_world_carrier: Array, T_world_link: Array, points: Array) -> Array:
    T = invert(T_world_carrier) @ T_world_link
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _flat(way: Array, axis: Array) -> Array:
    """Return the component of a vector (3,) across an axis."""
    return np.asarray(way - (way @ axis) * axis)


def _tool_axis(robot: RobotModel, q: Array, T_world_carrier: Array, out: Array) -> Array:
    """Return the tool axis (3,) in the carrier: that of the last joint if it points out of the gripper, else `out`."""
    out = out / np.linalg.norm(out)
    last = robot.jacobian(q)[3:, -1]
    if np.linalg.norm(last) > 0.5:
        axis = T_world_carrier[:3, :3].T @ last
        axis = axis * np.sign(axis @ out)
        if axis @ out > ALONG:
            return np.asarray(axis)
    return np.asarray(out)
