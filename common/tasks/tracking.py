"""Stages that pick an object in motion, and whether it is still where it was expected: docs/conveyor.md."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common import messages as m
from common.config import GripperConfig
from common.robot.transforms import matrix_to_pose
from common.tasks.stages import Cycle, Grip, Move, Stage

Array = npt.NDArray[np.float64]

CAUGHT_UP = 0.1  # share of the time that is left in which a late arm catches up
SETTLE = 0.2  # [s] that the fingers have more than they need to close at full speed


@dataclass
class Expected:
    """What a motion to a moving object was planned with."""

    belt: str
    stamp: float  # of the encoder reading [s]
    position: float  # of the belt then [m]
    speed: float  # [m/s]
    begins: float = 0.0  # cell time at which the arm starts [s]
    closes: float = math.inf  # cell time at which the fingers start to close [s]

    def lag(self, motion: m.MotionStatus) -> float:
        """Return how late the arm will be as the fingers start to close, if it catches up until then [s]."""
        lag = motion.header.stamp * 1e-9 - self.begins - motion.path_time
        left = self.closes - self.begins - motion.path_time
        return lag - CAUGHT_UP * max(left, 0.0)

    def deviation(self, state: m.ConveyorState | None) -> float:
        """Return how far the object will be from where it was expected when the fingers close, along the belt [m]."""
        belt = state.find(self.belt) if state is not None else None
        if state is None or belt is None:
            return 0.0
        now = state.header.stamp * 1e-9
        so_far = belt.position - self.position - self.speed * (now - self.stamp)
        return so_far + (belt.speed - self.speed) * max(0.0, self.closes - now)


def pick_stages(
    T_world_tcp: Array, thing: m.CollisionObject, stamp: int, begin: int, gripper: GripperConfig, cycle: Cycle, *,
    width: float, opening: float, approach: float, travel: float, width_tolerance: float, state: str = "GRASPING",
) -> list[Stage]:
    """Return the motion that meets an object, stays with it while the fingers close, and lifts it; and the grasp.

    Args:
        T_world_tcp: (4, 4) grasp pose of the tool at the time `stamp`.
        thing: the object, with its velocity.
        stamp, begin: cell times of the pose, and at which the arm starts [ns].
        gripper: its fingers may touch the object.
        cycle: of the stages.
        width, opening: of the object between the fingers, and of the open fingers [m].
        approach: height above the object at which it is met [m].
        travel: most way of the object from now until the arm leaves it [m].
        width_tolerance: of the width [m].
        state: reported in the status.
    """
    goal = m.MovingGoal(
        pose=matrix_to_pose(T_world_tcp), stamp=stamp, velocity=thing.velocity, begin=begin, approach=approach,
        dwell=gripper.least_time(opening - width) + SETTLE, travel=travel)
    return [
        Move("track", state, cycle, goal=goal, start_at=begin, needs_fresh_image=True,
             touches=[(link, thing.id) for link in gripper.links]),
        Grip("close", state, cycle, width=0.0, holds=True, early=True, effort=thing.grip_effort, mass=thing.mass,
             expected_width=width, width_tolerance=width_tolerance),
    ]


def time_grip(grip: Grip, move: Move, response: m.PlanResponse) -> float:
    """Let the fingers start to close when the tool is at the object; return the cell time of that [s]."""
    assert response.trajectory is not None
    grip.lead = response.trajectory.points[-1].time_from_start - response.meet_time
    return move.start_at * 1e-9 + response.meet_time
