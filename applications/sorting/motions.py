"""Stages that take one object to a container, stir the heap, or put something back; no state."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from applications.sorting.choice import Option
from applications.sorting.placing import SPREAD
from applications.sorting.scene import FOREIGN
from applications.sorting.topics import SeenObject
from common import messages as m
from common.config import GripperConfig
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix, tool_down
from common.tasks.stages import AwaitImage, Cycle, Grip, Move, Stage, View, place_of

NEAR = 0.15  # [m] from the grasp: the fingers may touch objects there, and the held object may leave them
SUPPORTED = 0.012  # [m] between an object and what it lies on, as seen
CONTACT = 0.10  # [m] of the lift in which the held object may touch what it touched before
LIFT = 0.12  # [m]
BLEND = 0.04  # [m]
TILTED = math.radians(25)  # [rad] tool at the release
WIDTH_OFF = 0.003  # [m] between widths that need no motion of the fingers
STRONG, WEAK = 40.0, 30.0  # [N] grip force for objects of this volume and more, and for the smallest
STRONG_FROM = 6e-5  # [m^3]
STIR_LENGTH = 0.10  # [m]
STIR_DEPTH = 0.02  # [m] of closed finger tips above the floor of the tray
STIR_ABOVE = 0.15  # [m]
FREE_OF = 0.03  # [m] between finger tips and an object before they push it
TURNED = 0.6  # cosine between directions of pushes that differ
OFF_WALL = 0.028  # [m] between the tool and walls of the tray


@dataclass(eq=False)
class Pick(Cycle):
    """The object that is taken: its options, of which the planner selects one.

    Attributes:
        options: grasps among which the planner chooses.
        chosen: the one that it reaches first; None before.
        spot: (x, y) of the release [m], and z of the tool there.
        inside: number of objects that were seen in its container.
        before: objects in the tray when the grasp was chosen.
        gripped: whether the fingers closed on it.
        checked: whether what is held is known.
        back: whether the held object goes back to the tray.
    """

    options: list[Option] = field(default_factory=list)
    chosen: Option | None = None
    spot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    before: list[SeenObject] = field(default_factory=list)
    inside: int = 0
    gripped: bool = False
    checked: bool = False
    back: bool = False


def grip_force(volume: float, most: float) -> float:
    """Return the grip force for an object of a volume [m^3], at most `most` [N]."""
    share = min(1.0, max(volume, 0.0) / STRONG_FROM)
    return min(WEAK + (STRONG - WEAK) * share, most)


def approach(cycle: Pick) -> Move:
    """Return the motion above the best grasps: the quickest that is reachable wins."""
    goals: list[m.JointGoal | m.PoseGoal] = [m.JointGoal(positions=one.grasp.q_approach) for one in cycle.options]
    return Move("approach", "GRASPING", cycle, goal=m.GoalSet(goals=goals), needs_fresh_image=True)


def take(cycle: Pick, gripper: GripperConfig, view: View) -> list[Stage]:
    """Return descend, close, and the way across to the release, for the chosen grasp."""
    assert cycle.chosen is not None
    grasp, thing = cycle.chosen.grasp, cycle.chosen.thing
    down, up = contacts(cycle, gripper, view)
    descend = Move("descend", "GRASPING", cycle, goal=m.PoseGoal(pose=grasp.pose), straight=True, touches=down,
                   needs_full_plan=True)
    close = Grip("close", "GRASPING", cycle, width=0.0, holds=True, early=True,
                 effort=grip_force(thing.volume, gripper.max_effort))
    return [descend, close, *carry(cycle, gripper, grasp.pose, up)]


def contacts(
    cycle: Pick, gripper: GripperConfig, view: View,
) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Return the pairs that may touch on the way down to the chosen grasp, and on the way up."""
    assert cycle.chosen is not None
    grasp, thing = cycle.chosen.grasp, cycle.chosen.thing
    near = neighbors(view, place_of(grasp.pose)[:2])
    fingers = [(link, name) for link in gripper.links for name in near]
    return fingers, [*fingers, *((thing.id, name) for name in [*near, *supports(thing, view)] if name != thing.id)]


def carry(cycle: Pick, gripper: GripperConfig, start: m.Pose, touches: list[tuple[str, str]]) -> list[Stage]:
    """Return one motion from the grasp, up and across to above the spot, and the release there.

    Args:
        cycle: with the spot.
        gripper: of the robot.
        start: pose of the tool.
        touches: pairs that may touch on the way.
    """
    over, lifted = over_spot(cycle.spot), m.PoseGoal(pose=raised(start, LIFT))
    apart: list[Stage] = [lift(cycle, start, touches), Move("across", "PLACING", cycle, goal=over, carries=True)]
    joined = m.SequenceGoal(items=[
        m.SequenceItem(goal=lifted, straight=True, blend_radius=BLEND), m.SequenceItem(goal=over)])
    return [Move("carry", "CHECKING", cycle, goal=joined, carries=True, touches=touches, fallback=apart),
            release(cycle, gripper)]


def lift(cycle: Pick, start: m.Pose, touches: list[tuple[str, str]]) -> Move:
    """Return the motion straight up from the pose of the tool, touching the pairs."""
    return Move("lift", "CHECKING", cycle, goal=m.PoseGoal(pose=raised(start, LIFT)), straight=True, carries=True,
                touches=touches)


def over_spot(spot: tuple[float, float, float]) -> m.PoseGoal:
    """Return the region above a spot from which the fingers may release."""
    return m.PoseGoal(
        pose=matrix_to_pose(tool_down(*spot)), position_tolerance=m.Vector3(x=SPREAD, y=SPREAD, z=0.02),
        tilt_tolerance=TILTED, yaw_tolerance=math.pi)


def release(cycle: Pick, gripper: GripperConfig) -> Grip:
    """Return the stage that opens the fingers; fully: an object may be wider than it was seen, or turned."""
    return Grip("release", "PLACING", cycle, width=gripper.max_width, carries=True, holds=False, early=True)


def neighbors(view: View, place: tuple[float, float], within: float = NEAR) -> list[str]:
    """Return ids of targets near a position (x, y) [m]; foreign bodies are none."""
    found = []
    for thing in view.objects("target"):
        if thing.kind == FOREIGN:
            continue
        radius = max((math.hypot(*corner) for corner in thing.outline), default=max(thing.dimensions) / 2)
        if math.dist(place_of(thing.pose)[:2], place) - radius < within:
            found.append(thing.id)
    return found


def supports(thing: SeenObject, view: View) -> list[str]:
    """Return ids of known solids on which an object lies: it leaves them upwards."""
    solids = [*view.objects("container"), *view.objects("fixture")]
    return [each.id for each in solids if each.shape == "box"
            and abs(each.pose.position.z + each.dimensions[2] / 2 - thing.bottom) < SUPPORTED]


def attach_pose(option: Option, view: View, name: str) -> m.Pose | None:
    """Return the pose of an object of the planning scene in the frame of the tool while it is gripped."""
    found = next((thing for thing in view.objects("target") if thing.id == name), None)
    if found is None:
        return None
    return matrix_to_pose(invert(pose_to_matrix(option.grasp.pose)) @ pose_to_matrix(found.pose))


def raised(pose: m.Pose, height: float) -> m.Pose:
    """Return a pose that is higher in world [m]."""
    at = pose.position
    return pose.model_copy(update={"position": m.Vector3(x=at.x, y=at.y, z=at.z + height)})


def put_back(
    cycle: Pick, gripper: GripperConfig, spot: tuple[float, float, float], lowered: float,
) -> list[Stage]:
    """Return the way to a spot of the tray, down to it, and home; the picture shows what lies there then."""
    x, y, _ = spot
    down = m.PoseGoal(pose=matrix_to_pose(tool_down(x, y, lowered)))
    above = m.PoseGoal(pose=matrix_to_pose(tool_down(*spot)))
    return [
        Move("back", "PLACING", cycle, goal=above, carries=True),
        Move("lower", "PLACING", cycle, goal=down, straight=True, carries=True),
        Grip("release", "PLACING", cycle, width=gripper.max_width, carries=True, holds=False),
        Move("up", "HOMING", cycle, goal=above, straight=True),
        Move("home", "HOMING", cycle, goal=m.JointGoal(named="home")),
        AwaitImage(),
    ]


def stir(
    view: View, gripper: GripperConfig, start: tuple[float, float], end: tuple[float, float], floor: float,
) -> list[Stage]:
    """Return a push with closed fingers along a straight line, low above the floor of the tray.

    Args:
        view: its targets may be touched.
        gripper: of the robot.
        start: (x, y) in world [m].
        end: (x, y) in world [m].
        floor: height of the tray's floor [m].
    """
    cycle = Cycle("heap")
    yaw = math.atan2(end[1] - start[1], end[0] - start[0])
    turn = math.remainder(yaw + (math.pi / 2 if gripper.closing_axis == "x" else 0.0), math.pi)

    def at(place: tuple[float, float], z: float) -> m.PoseGoal:
        return m.PoseGoal(pose=matrix_to_pose(tool_down(*place, z, turn)))

    low = floor + STIR_DEPTH
    touches = [(link, thing.id) for link in gripper.links for thing in view.objects("target") if thing.kind != FOREIGN]
    return [
        Grip("shut", "STIRRING", cycle, width=0.0),
        Move("above", "STIRRING", cycle, goal=at(start, low + STIR_ABOVE),
             needs_full_plan=True, needs_fresh_image=True),
        Move("down", "STIRRING", cycle, goal=at(start, low), straight=True, touches=touches),
        Move("push", "STIRRING", cycle, goal=at(end, low), straight=True, touches=touches),
        Move("up", "STIRRING", cycle, goal=at(end, low + STIR_ABOVE), straight=True, touches=touches),
        Move("home", "HOMING", goal=m.JointGoal(named="home")),
        Grip("open", "HOMING", width=gripper.max_width),
        AwaitImage(),
    ]


def push_line(
    thing: SeenObject, center: tuple[float, float], inner: float, attempt: int,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return start and end (x, y) [m] of a push through an object, as far towards the middle of the tray as possible.

    An object at a wall, behind which there is no room for the tool, is pushed along the wall.

    Args:
        thing: the object to push.
        center: of the tray.
        inner: half side of the area in which the tool may be [m].
        attempt: number of pushes before: each takes the next best direction.
    """
    middle = np.array(center)
    at = np.clip([thing.center.x, thing.center.y], middle - inner, middle + inner)
    inward = middle - at
    angles = np.radians(np.arange(0, 360, 15)) + (math.atan2(inward[1], inward[0]) if inward.any() else thing.yaw)
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    behind = at - ways * (max(thing.size.x, thing.size.y) / 2 + FREE_OF)
    missing = np.linalg.norm(behind - np.clip(behind, middle - inner, middle + inner), axis=1)
    turned = np.abs(np.remainder(angles - angles[0] + math.pi, 2 * math.pi) - math.pi)
    order = np.lexsort((turned, np.round(missing, 2)))
    chosen: list[int] = []
    for index in order.tolist():  # directions that differ
        if all(float(ways[index] @ ways[other]) < TURNED for other in chosen):
            chosen.append(index)
    best = chosen[attempt % len(chosen)]
    start = np.clip(behind[best], middle - inner, middle + inner)
    end = np.clip(at + ways[best] * STIR_LENGTH, middle - inner, middle + inner)
    return (float(start[0]), float(start[1])), (float(end[0]), float(end[1]))
