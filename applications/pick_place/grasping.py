"""Parameters of the pick-and-place task."""

from __future__ import annotations

import warnings
from typing import Self

from pydantic import Field, model_validator

from common.config import Grasp, GripperConfig, Parameters, Surroundings, Tunable
from common.tasks.decisions import TaskConfig

PLACES = {"finger_inner": "gripper.fingers.inner", "finger_outer": "gripper.fingers.depth, from the inner face",
          "finger_half_width": "gripper.fingers.half_width"}


RELEASED = 0.9  # [rad] tilt allowed above a container for an arm with few joints: a released object falls


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
        10, ge=1, le=1000, description="failures in a row after which the task gives up"
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
