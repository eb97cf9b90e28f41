"""Parameters of the pick-and-place task, and which gripper yaws are free for an object."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from pydantic import Field, model_validator

from common import messages as m
from common.config import Container, Grasp, GripperConfig, Parameters, Surroundings, Tunable
from common.robot.transforms import matrix_to_rpy, pose_to_matrix
from common.scene.workspace import yaw_candidates
from common.tasks.decisions import TaskConfig
from common.tasks.stages import Place, place_of

PLACES = {"finger_inner": "gripper.fingers.inner", "finger_outer": "gripper.fingers.depth, from the inner face",
          "finger_half_width": "gripper.fingers.half_width"}


RELEASED = 0.9  # [rad] tilt allowed above a container for an arm with few joints: a released object falls

YawRange = tuple[float, float]  # center and half width [rad]
FINE = 36  # yaws per half turn at which the gripper's clearance is checked


class HandShape(Parameters):
    """The open fingers seen from above: two rectangles next to the object, in the frame of the tool center point.

    Their default is the shape of the robot file's gripper. Setting a shape here is deprecated.
    """

    finger_inner: Tunable[float] = Field(0.040, gt=0, le=0.2, description="centre to inner finger face, open [m]")
    finger_outer: Tunable[float] = Field(
        0.056, gt=0, le=0.2, description="centre to outer end of a finger tip, open [m]"
    )
    finger_half_width: Tunable[float] = Field(0.011, gt=0, le=0.1, description="half the width of a finger tip [m]")
    min_clearance: Tunable[float] = Field(
        0.003, ge=0, le=0.05, description="least gap between a finger and a neighbour [m]"
    )
    yaw_count: Tunable[int] = Field(8, ge=1, le=36, description="orientations tried, spread over half a turn")


class Config(TaskConfig):
    """Parameters of the task; times are cell time unless they say wall."""

    world: Surroundings
    grasp: Grasp
    grasp_pos_tol: Tunable[float] = Field(
        0.04, gt=0, le=0.2, description="side of the goal box of pre-grasp and lift [m]"
    )
    place_pos_tol: Tunable[float] = Field(
        0.06, gt=0, le=0.2, description="side of the goal box above the container; half of it where one of its columns "
                                         "is meant [m]"
    )
    orient_tol_rad: Tunable[float] = Field(0.25, ge=0, le=1.5, description="tilt of the tool that a goal allows [rad]")
    orient_yaw_tol_rad: Tunable[float] = Field(
        3.14, ge=0, le=3.1415, description="turn about the tool that a goal allows [rad]"
    )
    goal_timeout: Tunable[float] = Field(
        60.0, gt=0, le=3600, description="a motion that takes longer is stopped [s]"
    )
    grace: Tunable[float] = Field(
        8.0, ge=0, le=600, description="wait while only objects are left that cannot be taken [s]"
    )
    empty: Tunable[float] = Field(
        1.0, ge=0.1, le=600, description="wait with an empty table before the task is done [s]"
    )
    max_retries: Tunable[int] = Field(3, ge=0, le=100, description="grasps of one place that may close on nothing")
    max_failures: Tunable[int] = Field(
        10, ge=1, le=1000, description="failures, or grasps of nothing, in a row after which the task gives up"
    )
    moved: Tunable[float] = Field(
        0.005, gt=0, le=0.05, description="an object that is further from where it was has moved [m]"
    )
    look_from: list[float] = Field(
        [], max_length=32, description="joint positions from which the camera sees past the arm [rad]; empty: found by "
                                       "the shape of the robot"
    )
    look_timeout: float = Field(
        20.0, ge=1, le=3600, description="ERROR once it could not see the table for so long [s]"
    )
    width_tolerance: Tunable[float] = Field(
        0.01, gt=0, le=0.05, description="what is grasped may be so much wider or narrower than it was seen [m]"
    )
    joined: Tunable[bool] = Field(
        True, description="one motion leads to an object and down to it, another up and across, where possible"
    )
    hand: HandShape = HandShape()

    @model_validator(mode="after")
    def _hand_is_that_of_the_robot(self) -> Self:
        gripper = self.robot.gripper
        if gripper is not None:
            self.hand = shaped_as(gripper, self.hand)
        return self


def shaped_as(gripper: GripperConfig, hand: HandShape) -> HandShape:
    """Return the hand with the gripper's finger shape, where its own shape was not set."""
    if gripper.cup is not None:  # two halves of the square around it
        inner, depth, half_width = 0.0, gripper.cup.lip_radius, gripper.cup.lip_radius
    else:
        inner, depth, half_width = gripper.finger_inner, gripper.fingers.depth, gripper.fingers.half_width
    shape = {"finger_inner": inner, "finger_outer": inner + depth, "finger_half_width": half_width}
    for name in shape.keys() & hand.model_fields_set:
        if getattr(hand, name) != shape[name]:
            warnings.warn(f"services.<task>.hand.{name} belongs to the robot file: {PLACES[name]}", FutureWarning,
                          stacklevel=2)
    return hand.model_copy(update={name: value for name, value in shape.items() if name not in hand.model_fields_set})


@dataclass
class Target:
    """A detected object: its position [m] in world, and its track id in the planning scene.

    `size` (x, y) [m] and `yaw` [rad] are set for a box, seen from above. `grip_effort` [N] and `mass` [kg] are those of
    the planning scene, 0 for unknown.
    """

    id: str
    position: Place
    radius: float = 0.0  # of the circle around it, seen from above [m]
    size: tuple[float, float] | None = None
    yaw: float = 0.0
    grip_effort: float = 0.0
    mass: float = 0.0

    @classmethod
    def of(cls, thing: m.CollisionObject) -> Target:
        """Create a target from an object of the planning scene."""
        d = thing.dimensions
        if thing.shape != "box":
            return cls(thing.id, place_of(thing.pose), d[0], grip_effort=thing.grip_effort, mass=thing.mass)
        yaw = matrix_to_rpy(pose_to_matrix(thing.pose)[:3, :3])[2]
        radius = math.hypot(d[0], d[1]) / 2
        return cls(thing.id, place_of(thing.pose), radius, (d[0], d[1]), yaw, thing.grip_effort, thing.mass)

    def width(self, yaw: float) -> float | None:
        """Return the finger width for a gripper yaw [rad] [m]; None for unknown size."""
        if self.size is None:
            return 2 * self.radius or None
        return self.size[1] if abs(math.cos(yaw - self.yaw)) > math.sqrt(0.5) else self.size[0]


def finger_clearance(
    shape: HandShape, center: Sequence[float], yaw: float, neighbours: Sequence[Sequence[float]], radius: float,
    container: Container | None = None,
) -> float:
    """Return the smallest gap [m] between the open fingers and any neighbor; negative for overlap.

    The fingers open along the tool's y axis: the -y axis of world for a tool pointing down at yaw 0.

    Args:
        shape: the fingers.
        center: (x, y) of the object to take [m], world.
        yaw: of the tool about world z [rad].
        neighbours: (x, y) of other balls [m], world, followed by a radius that differs from `radius`.
        radius: of the balls [m].
        container: an open box whose walls must be cleared as well.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    half_length = (shape.finger_outer - shape.finger_inner) / 2
    middle = (shape.finger_outer + shape.finger_inner) / 2
    best = math.inf
    for x, y, *own in neighbours:
        dx, dy = x - center[0], y - center[1]
        lateral, along = c * dx + s * dy, -s * dx + c * dy
        gap_lateral = max(abs(lateral) - shape.finger_half_width, 0.0)
        gap_along = max(abs(abs(along) - middle) - half_length, 0.0)
        best = min(best, math.hypot(gap_lateral, gap_along) - (own[0] if own else radius))
    if container is not None:
        best = min(best, _container_gap(shape, center, c, s, container))
    return best


def _container_gap(shape: HandShape, center: Sequence[float], c: float, s: float, container: Container) -> float:
    """Return the gap between the fingers' corners and the container's outer square [m]; negative inside."""
    best = math.inf
    for along in (-shape.finger_outer, -shape.finger_inner, shape.finger_inner, shape.finger_outer):
        for lateral in (-shape.finger_half_width, shape.finger_half_width):
            x = center[0] + c * lateral - s * along - container.x
            y = center[1] + s * lateral + c * along - container.y
            dx, dy = abs(x) - container.half_side, abs(y) - container.half_side
            inside = min(max(dx, dy), 0.0)
            best = min(best, math.hypot(max(dx, 0.0), max(dy, 0.0)) + inside)
    return best


def grasp_yaws(
    shape: HandShape, center: Sequence[float], neighbours: Sequence[Sequence[float]], radius: float,
    container: Container | None = None, yaws: Sequence[float] | None = None,
) -> list[float]:
    """Return the yaws [rad] with clear fingers, smallest rotation first; empty when there is no room.

    `yaws` restricts the candidates to those that the object allows.
    """
    near = [n for n in neighbours if math.dist(n[:2], center[:2]) < shape.finger_outer + 2 * radius + 0.05]
    return [
        yaw
        for yaw in (yaw_candidates(shape.yaw_count) if yaws is None else yaws)
        if finger_clearance(shape, center, yaw, near, radius, container) >= shape.min_clearance
    ]


def yaw_ranges(clear: Sequence[float]) -> list[YawRange]:
    """Group yaws of `yaw_candidates(FINE)` into contiguous ranges of a full turn."""
    if len(clear) == FINE:
        return [(0.0, math.pi)]
    step = math.pi / FINE
    free = {round(yaw / step) % FINE for yaw in clear}
    ranges: list[YawRange] = []
    for first in sorted(number for number in free if (number - 1) % FINE not in free):
        count = next(n for n in range(1, FINE + 1) if (first + n) % FINE not in free)
        half = (count - 1) / 2
        middle = (first + half) * step
        ranges += [(math.remainder(middle + turn, 2 * math.pi), half * step) for turn in (0.0, math.pi)]
    return ranges


def yaws_of(target: Target, shape: HandShape) -> list[float] | None:
    """Return the yaws [rad] at which the finger pads lie flat on two faces of a box that fits between them.

    None for a round object and for a suction cup: any yaw will do.
    """
    if target.size is None or not shape.finger_inner:
        return None
    # At the box's yaw the fingers close along its y axis, a quarter turn from there along its x axis.
    fitting = [target.yaw + turn for width, turn in ((target.size[1], 0.0), (target.size[0], math.pi / 2))
               if width <= 2 * (shape.finger_inner - shape.min_clearance)]
    turned = [math.remainder(yaw, math.pi) for yaw in fitting]  # a parallel gripper repeats after half a turn
    return sorted(turned, key=lambda yaw: (abs(yaw), -yaw))
