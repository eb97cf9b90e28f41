"""A gripper of one jaw that turns towards a fixed finger, measured on the model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.robot.model import RobotModel
from common.robot.transforms import invert
from tools.robot_setup.fingers import ALIGNED, TIP, Grip, link_points, links_moved, told

Array = NDArray[np.float64]

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


def jaw_complaints(robot: RobotModel, points: dict[str, Array] | None = None) -> list[str]:
    """As `tools.robot_setup.fingers.tool_complaints`, of a robot with a jaw."""
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
        way = told(closing).removeprefix("-")
        complaints.append(f"gripper.closing_axis: the jaw closes along {way} of {name}, not along {axis}")
    if approach[2] < ALIGNED:
        complaints.append(f"tcp_link: z of {name} must point from the palm to the tips of the jaws, which is "
                          f"{told(approach)}")
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
