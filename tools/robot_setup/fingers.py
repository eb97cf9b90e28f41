"""Which way fingers close, where they point and how wide they open, measured on the model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.robot_geometry import convex_hulls, shape_corners
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel
from common.robot.transforms import invert

Array = NDArray[np.float64]

TIP = 0.02  # of a finger, from its end on: what presses on things [m]
VAGUE = 0.01  # [m] from where fingers begin to their middle: it does not tell which way they point
PARALLEL = 0.03  # pads that turn by less while they close [rad]
ALIGNED = math.cos(math.radians(10))


@dataclass(frozen=True)
class Grip:
    """What two fingers do, in the frame of a link that carries both; all but the axes in [m].

    Attributes:
        pads: the links at their ends, the first lies farther along `closing`.
        closing: (3,) unit axis along which they come together; approach: (3,) from where they begin to their tips.
        middle: (3,) between the closed pads, at the height of the tips.
        widths: between the pads at each of the positions that were asked for.
        turned: most that a pad turns meanwhile [rad].
        depth: of a tip along `closing`; half_width: half of it across.
    """

    pads: tuple[str, str]
    closing: Array
    approach: Array
    middle: Array
    widths: list[float]
    turned: float
    depth: float
    half_width: float


def link_points(robot: RobotModel) -> dict[str, Array]:
    """Corners (N, 3) [m] of the collision shapes of each link that has some, in its own frame.

    Raises:
        ConfigError: a mesh is not there.
    """
    found: dict[str, list[Array]] = {}
    for item in convex_hulls(robot.full_geometry(pin.GeometryType.COLLISION)).geometryObjects:
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
    """What the fingers do from the first of the positions of their joints, where they are closed, to the last, open.

    Args:
        robot: the model.
        carrier: a link that they all hang on.
        links: those that the joints move.
        joints: of the fingers.
        positions: of those joints, in their order [rad or m]; at least two.
        points: as of `link_points`.

    Returns:
        None where no two links with shapes move against each other.
    """
    q = np.clip(np.zeros(robot.dof), robot.lower, robot.upper)
    seen = [robot.link_poses(q, dict(zip(joints, row, strict=True))) for row in positions]

    def placed(link: str, at: int) -> Array:
        return invert(seen[at][carrier]) @ seen[at][link]

    def cloud(link: str, at: int) -> Array:
        T = placed(link, at)
        return np.asarray(points[link] @ T[:3, :3].T + T[:3, 3])

    shaped = [link for link in links if link in points]
    first = [link for link in links if robot.link_parents.get(link) not in links]
    if not shaped:
        return None
    start = np.mean([placed(link, 0)[:3, 3] for link in first], axis=0)
    moved = {link: cloud(link, -1).mean(axis=0) - cloud(link, 0).mean(axis=0) for link in shaped}
    reach = {link: float(np.linalg.norm(cloud(link, 0) - start, axis=1).max()) for link in shaped}
    one = max(shaped, key=lambda link: (round(reach[link], 3), float(np.linalg.norm(moved[link]))))
    against = [link for link in shaped if moved[link] @ moved[one] < -1e-9]
    if not against:
        return None
    other = max(against, key=lambda link: reach[link])
    closing = _unit(moved[one] - moved[other])
    along = (cloud(one, 0).mean(axis=0) + cloud(other, 0).mean(axis=0)) / 2 - start
    approach = along - (along @ closing) * closing
    if np.linalg.norm(approach) < VAGUE:  # fingers about their own frames: they point away from the arm
        robot.fk(q)
        T_carrier_world, wrist = invert(seen[0][carrier]), robot.data.oMi[robot.dof].translation
        along = along + start - (T_carrier_world[:3, :3] @ wrist + T_carrier_world[:3, 3])
        approach = along - (along @ closing) * closing
    if np.linalg.norm(approach) < 1e-3:
        return None
    approach = _unit(approach)

    def tip(link: str, at: int) -> Array:
        own = cloud(link, at)
        heights = own @ approach
        return np.asarray(own[heights > heights.max() - TIP])

    def ends(link: str, at: int, axis: Array) -> tuple[float, float]:
        values = tip(link, at) @ axis
        return float(values.min()), float(values.max())

    widths = [ends(one, at, closing)[0] - ends(other, at, closing)[1] for at in range(len(seen))]
    across = np.cross(closing, approach)
    sides = ends(one, 0, across)
    inner = (ends(one, 0, closing)[0] + ends(other, 0, closing)[1]) / 2
    height = max(float((cloud(link, 0) @ approach).max()) for link in (one, other))
    turns = [placed(one, 0)[:3, :3].T @ placed(one, at)[:3, :3] for at in range(len(seen))]
    low, high = ends(one, 0, closing)
    return Grip(
        pads=(one, other), closing=closing, approach=approach,
        middle=inner * closing + sum(sides) / 2 * across + height * approach,
        widths=widths, turned=max(math.acos(min(1.0, max(-1.0, (np.trace(R) - 1) / 2))) for R in turns),
        depth=high - low, half_width=(sides[1] - sides[0]) / 2,
    )


def _unit(vector: Array) -> Array:
    """Of length 1, and along an axis where it nearly is."""
    unit = vector / np.linalg.norm(vector)
    nearest = int(np.argmax(np.abs(unit)))
    if abs(unit[nearest]) > ALIGNED:
        unit = np.eye(3)[nearest] * np.sign(unit[nearest])
    return np.asarray(unit)


def links_moved(robot: RobotModel, joints: Sequence[str]) -> list[str]:
    """Links that any of some joints moves."""
    model = robot.full_model
    ids = {model.getJointId(name) for name in joints}
    return [link for link in robot.link_parents if ids & set(model.supports[_joint_of(model, link)])]


def _joint_of(model: pin.Model, link: str) -> int:
    return int(model.frames[model.getFrameId(link, pin.FrameType.BODY)].parentJoint)


def check_tool_frame(robot: RobotModel, points: dict[str, Array] | None = None) -> list[str]:
    """What of the tool's frame is not as the platform takes it to be, in one line each: none where all is well.

    The z axis of the tool centre point points from the palm to the tips of the fingers, which come together along the
    axis that `gripper.closing_axis` names, as wide apart as they are said to be.
    """
    gripper = robot.config.gripper
    if gripper is None or not gripper.joints:
        return []
    name, axis = robot.config.tcp_link, gripper.closing_axis
    widths = (0.0, gripper.max_width)
    found = measure(robot, name, links_moved(robot, gripper.joints), gripper.joints,
                    [finger_positions(gripper, width) for width in widths], points or link_points(robot))
    if found is None:
        return [f"gripper.joints: no two links that {', '.join(gripper.joints)} move come together"]
    complaints = []
    if abs(found.closing["xy".index(axis)]) < ALIGNED:
        way = axis_name(found.closing).removeprefix("-")
        complaints.append(f"gripper.closing_axis: the fingers close along {way} of {name}, not along {axis}")
    if found.approach[2] < ALIGNED:
        complaints.append(f"tcp_link: z of {name} must point from the palm to the tips of the fingers, which is "
                          f"{axis_name(found.approach)}")
    elif abs(found.widths[1] - found.widths[0] - gripper.max_width) > 0.1 * gripper.max_width:
        complaints.append(f"gripper.max_width: the fingers open by {found.widths[1] - found.widths[0]:.4f} m, not by "
                          f"{gripper.max_width:g} m")
    return complaints


def axis_name(axis: Array) -> str:
    """An axis in words: x, -z, or its numbers."""
    nearest = int(np.argmax(np.abs(axis)))
    if abs(axis[nearest]) > 0.999:
        return f"{'-' if axis[nearest] < 0 else ''}{'xyz'[nearest]}"
    return f"({', '.join(f'{value:.2f}' for value in axis)})"



ALONG = math.cos(math.radians(35))  # of the last joint's axis with the way to the tip: then that is the tool's axis
DROP = 0.012  # of the tip of the jaw behind where it is when closed, up to which it is opened [m]
CLOSED = 0.05  # by which the joint may be said to be closed elsewhere than it was measured to be [rad]
APART = 0.03  # between the tips when closed: more is no gripper [m]


@dataclass(frozen=True)
class Jaw:
    """What a jaw does: see `common.config.TurningJaw`; `grip` is in the frame of the link that carries it."""

    carrier: str
    radius: float
    angle: float
    closed: float
    opens: int
    max_width: float
    grip: Grip


def measure_jaw(robot: RobotModel, joint: str, points: dict[str, Array]) -> Jaw | str:
    """The jaw that a joint turns, or why it is none.

    Closed is that end of the joint at which its tip is nearer to that of what does not turn with it. The middle of the
    grip is half the width from the fixed finger, at which the hand is to come to what it takes: closing moves the one
    jaw alone, so that the last of the way the fixed finger moves the object, or the object the hand.

    Args:
        robot: the model.
        joint: of the jaw.
        points: as of `tools.robot_setup.fingers.link_points`.
    """
    model = robot.full_model
    index = model.joints[model.getJointId(joint)].idx_q
    ends = float(model.lowerPositionLimit[index]), float(model.upperPositionLimit[index])
    moved = links_moved(robot, [joint])
    carrier = robot.link_parents[next(link for link in moved if robot.link_parents[link] not in moved)]
    shaped = [link for link in moved if link in points]
    fixed = [link for link in points if link not in moved and _rigid(robot, link) == _rigid(robot, carrier)]
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
    pivot = T[ends[0]][:3, 3]
    turn = pin.log3(T[ends[1]][:3, :3] @ T[ends[0]][:3, :3].T)
    axis = turn / np.linalg.norm(turn)

    def far(cloud: Array) -> Array:
        """How far points are from the axis (N,)."""
        away = cloud - pivot
        return np.asarray(np.linalg.norm(away - np.outer(away @ axis, axis), axis=1))

    def farthest(cloud: Array) -> Array:
        return np.asarray(cloud[int(np.argmax(far(cloud)))])

    def gap(at: float) -> float:
        """Between the corners at the tips of jaw and finger, seen along the axis [m]."""
        one, other = (cloud[far(cloud) > far(cloud).max() - TIP] for cloud in (jaws[at], still))
        ways = (one[:, None] - other[None]).reshape(-1, 3)
        return float(np.linalg.norm(ways - np.outer(ways @ axis, axis), axis=1).min())

    closed, opened = sorted(ends, key=gap)
    approach = _tool_axis(robot, q, seen[closed][carrier], _flat(farthest(jaws[closed]) - pivot, axis))
    closing = np.cross(approach, axis)  # either way of these
    tip = jaws[closed][jaws[closed] @ approach > (jaws[closed] @ approach).max() - TIP]
    if (farthest(jaws[opened]) - farthest(jaws[closed])) @ closing < 0:
        closing = -closing
    inner = tip[int(np.argmin(tip @ closing))]
    if gap(closed) > APART:
        return f"the jaw of {joint} does not come to what is fixed: they are more than {1e3 * APART:.0f} mm apart"
    along, out = float((inner - pivot) @ approach), float((inner - pivot) @ closing)
    radius, angle = math.hypot(along, out), math.atan2(out, along)
    most = min(abs(opened - closed), math.acos(max(0.0, math.cos(angle) - DROP / radius)) - angle)
    width = radius * (math.sin(angle + most) - math.sin(angle))
    across = np.cross(closing, approach)
    sides, faces = tip @ across, tip @ closing
    height = float((tip @ approach).max())
    middle = (float(inner @ closing) + width / 2) * closing + float(sides.max() + sides.min()) / 2 * across
    grip = Grip(pads=(shaped[0], carrier), closing=closing, approach=approach, middle=middle + height * approach,
                widths=[0.0, width], turned=most, depth=float(faces.max() - faces.min()),
                half_width=float(sides.max() - sides.min()) / 2)
    return Jaw(carrier, round(radius, 5), round(angle, 5), round(closed, 5), 1 if opened > closed else -1,
               round(width - 5e-5, 4), grip)


def check_jaw(robot: RobotModel, points: dict[str, Array] | None = None) -> list[str]:
    """As `tools.robot_setup.fingers.check_tool_frame`, of a robot with a jaw."""
    gripper = robot.config.gripper
    assert gripper is not None and gripper.jaw is not None
    found = measure_jaw(robot, gripper.joints[0], points or link_points(robot))
    if isinstance(found, str):
        return [f"gripper.joints: {found}"]
    name, axis, given = robot.config.tcp_link, gripper.closing_axis, gripper.jaw
    poses = robot.link_poses(np.clip(np.zeros(robot.dof), robot.lower, robot.upper))
    R = invert(poses[name])[:3, :3] @ poses[found.carrier][:3, :3]
    closing, approach = R @ found.grip.closing, R @ found.grip.approach
    complaints = []
    if abs(closing["xy".index(axis)]) < ALIGNED:
        way = axis_name(closing).removeprefix("-")
        complaints.append(f"gripper.closing_axis: the jaw closes along {way} of {name}, not along {axis}")
    if approach[2] < ALIGNED:
        complaints.append(f"tcp_link: z of {name} must point from the palm to the tips of the jaws, which is "
                          f"{axis_name(approach)}")
    if given.opens != found.opens or abs(given.closed - found.closed) > CLOSED:
        complaints.append(f"gripper.jaw: it is closed at {found.closed:g} and opens by {found.opens:+d}, not at "
                          f"{given.closed:g} and by {given.opens:+d}")
    elif abs(given.radius - found.radius) > 0.1 * found.radius:
        complaints.append(f"gripper.jaw.radius: its tip is {found.radius:.4f} m from its axis, not {given.radius:g} m")
    return complaints


def _rigid(robot: RobotModel, link: str) -> int:
    model = robot.full_model
    return int(model.frames[model.getFrameId(link, pin.FrameType.BODY)].parentJoint)


def _placed(T_world_carrier: Array, T_world_link: Array, points: Array) -> Array:
    T = invert(T_world_carrier) @ T_world_link
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _flat(way: Array, axis: Array) -> Array:
    """Of a way (3,) what is across an axis."""
    return np.asarray(way - (way @ axis) * axis)


def _tool_axis(robot: RobotModel, q: Array, T_world_carrier: Array, out: Array) -> Array:
    """(3,) in the carrier: the axis about which the last joint turns, where it points out of the hand; else `out`."""
    out = out / np.linalg.norm(out)
    last = robot.jacobian(q)[3:, -1]
    if np.linalg.norm(last) > 0.5:
        axis = T_world_carrier[:3, :3].T @ last
        axis = axis * np.sign(axis @ out)
        if axis @ out > ALONG:
            return np.asarray(axis)
    return np.asarray(out)
