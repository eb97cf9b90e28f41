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


def tool_complaints(robot: RobotModel, points: dict[str, Array] | None = None) -> list[str]:
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
        way = told(found.closing).removeprefix("-")
        complaints.append(f"gripper.closing_axis: the fingers close along {way} of {name}, not along {axis}")
    if found.approach[2] < ALIGNED:
        complaints.append(f"tcp_link: z of {name} must point from the palm to the tips of the fingers, which is "
                          f"{told(found.approach)}")
    elif abs(found.widths[1] - found.widths[0] - gripper.max_width) > 0.1 * gripper.max_width:
        complaints.append(f"gripper.max_width: the fingers open by {found.widths[1] - found.widths[0]:.4f} m, not by "
                          f"{gripper.max_width:g} m")
    return complaints


def told(axis: Array) -> str:
    """An axis in words: x, -z, or its numbers."""
    nearest = int(np.argmax(np.abs(axis)))
    if abs(axis[nearest]) > 0.999:
        return f"{'-' if axis[nearest] < 0 else ''}{'xyz'[nearest]}"
    return f"({', '.join(f'{value:.2f}' for value in axis)})"


