"""Goals and requests of the planning tests."""

import numpy as np

from common.messages import JointGoal, PlanRequest, PoseGoal
from common.planning.ik import solve_ik
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.scenes import FINGERS, HOME, ROBOT


def touching(name: str) -> list[tuple[str, str]]:
    return [(finger, name) for finger in FINGERS]


def above(x, y, z, yaw=0.0) -> np.ndarray:
    q = solve_ik(ROBOT, tool_down(x, y, z, yaw), HOME)
    assert q is not None
    return q


LEFT, RIGHT = above(0.5, 0.3, 0.2), above(0.5, -0.3, 0.2)


def down(x, y, z, yaw=0.0, **tolerances) -> PoseGoal:
    """A goal with the tool pointing down."""
    return PoseGoal(pose=matrix_to_pose(tool_down(x, y, z, yaw)), **tolerances)


def to(goal, start=HOME, **more) -> PlanRequest:
    return PlanRequest(id="1", start=list(start), goal=goal, **more)


def to_pose(T, start, **more) -> PlanRequest:
    goal = {k: more.pop(k) for k in ("position_tolerance", "tilt_tolerance", "yaw_tolerance") if k in more}
    return to(PoseGoal(pose=matrix_to_pose(T), **goal), start, **more)


def to_joints(goal, start, **more) -> PlanRequest:
    return to(JointGoal(positions=list(goal)), start, **more)
