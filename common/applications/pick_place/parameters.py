"""What can be set of the pick-and-place task."""

from __future__ import annotations

from pydantic import Field

from common.applications.pick_place.grasp import HandShape
from common.config import Parameters, Tunable


class PickPlaceParameters(Parameters):
    """How the task behaves; times are cell time unless they say wall."""

    grasp_pos_tol: Tunable[float] = Field(
        0.04, gt=0, le=0.2, description="side of the goal box of pre-grasp and lift [m]"
    )
    place_pos_tol: Tunable[float] = Field(
        0.06, gt=0, le=0.2, description="side of the goal box above the container [m]"
    )
    orient_tol_rad: Tunable[float] = Field(0.25, ge=0, le=1.5, description="tilt of the tool that a goal allows [rad]")
    orient_yaw_tol_rad: Tunable[float] = Field(
        3.14, ge=0, le=3.1415, description="turn about the tool that a goal allows [rad]"
    )
    planning_time: Tunable[float] = Field(2.0, gt=0, le=600, description="wall time for one plan [s]")
    goal_timeout: Tunable[float] = Field(
        60.0, gt=0, le=3600, description="a motion that takes longer is stopped [s]"
    )
    grace: Tunable[float] = Field(
        8.0, ge=0, le=600, description="wait while only objects are left that can not be taken [s]"
    )
    empty: Tunable[float] = Field(
        1.0, ge=0.1, le=600, description="wait with an empty table before the task is done [s]"
    )
    frame_timeout: Tunable[float] = Field(
        1.0, ge=0.1, le=60, description="an older picture starts no motion [s, wall time]"
    )
    clock_tolerance: Tunable[float] = Field(
        0.2, ge=0.01, le=10, description="a picture from so far in the future starts no motion: the clocks of camera "
                                         "and task differ [s, wall time]"
    )
    joint_states_timeout: Tunable[float] = Field(
        0.2, ge=0.05, le=60, description="without joint states for so long the arm is held on its path [s, wall time]"
    )
    max_retries: Tunable[int] = Field(3, ge=0, le=100, description="grasps of one place that may close on nothing")
    max_failures: Tunable[int] = Field(
        10, ge=1, le=1000, description="failures in a row after which the task gives up"
    )
    moved: Tunable[float] = Field(
        0.005, gt=0, le=0.05, description="an object that is further from where it was has moved [m]"
    )
    hand: HandShape = HandShape()
