"""From a target of a program to a goal of the planner and the pose of the tool there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from applications.programming.model import Target
from common import messages as m
from common.config import Grasp, GripperConfig
from common.errors import UnknownName, ZencellError
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform
from common.saved_poses import SavedPoses

Array = NDArray[np.float64]


class StepProblem(ZencellError):
    """A step that cannot be turned into stages: an unknown pose, no such object."""


class NotSeen(StepProblem):
    """No fitting object is seen yet."""


@dataclass(frozen=True)
class Cell:
    """What the stages depend on besides the step."""

    robot: RobotModel
    gripper: GripperConfig | None
    grasp: Grasp
    saved: Callable[[], SavedPoses]
    width_tolerance: float = 0.01  # of a grasped object [m]

    def resolve(
        self, target: Target, poses: Mapping[str, Target], start: Array | None
    ) -> tuple[m.JointGoal | m.PoseGoal, Array]:
        """Return the goal of a target and the pose (4, 4) of the tool there. Raises StepProblem."""
        found = poses.get(target.name, target)
        if found.name:
            return self._named(found.name, poses)
        if found.joints is not None:
            if len(found.joints) != len(self.robot.joint_names):
                raise StepProblem(f"joints: {len(found.joints)} values for {len(self.robot.joint_names)} joints: "
                                  f"{', '.join(self.robot.joint_names)}")
            return m.JointGoal(positions=found.joints), self.robot.fk(found.joints)
        if found.position is not None:
            T = transform(rpy_to_matrix(*found.rpy), found.position)
        else:
            assert found.by is not None
            if start is None:
                raise StepProblem("by: the pose of the tool is not known")
            T = start.copy()
            T[:3, 3] += found.by if found.frame == "world" else start[:3, :3] @ np.array(found.by)
            T[:3, :3] = T[:3, :3] @ rpy_to_matrix(*found.turn)
        return pose_goal(T), T

    def _named(self, name: str, poses: Mapping[str, Target]) -> tuple[m.JointGoal, Array]:
        config = self.robot.config
        if name in config.named_poses:
            return m.JointGoal(named=name), self.robot.fk(config.named_poses[name])
        saved = self.saved()
        if name not in saved.poses:
            raise StepProblem(str(UnknownName("pose", name, {*poses, *config.named_poses, *saved.poses})))
        q = saved.named(name, self.robot.joint_names)
        return m.JointGoal(positions=q), self.robot.fk(q)

    def require_gripper(self) -> GripperConfig:
        """Return the gripper. Raises StepProblem."""
        if self.gripper is None:
            raise StepProblem("the robot of this cell has no gripper")
        return self.gripper


def backed(T: Array, distance: float, axis: str) -> Array:
    """Return the pose (4, 4) of a tool that is moved back along its z axis, or up in world [m]."""
    moved = T.copy()
    moved[:3, 3] += (0.0, 0.0, distance) if axis == "world" else -distance * T[:3, 2]
    return moved


def pose_goal(T: Array) -> m.PoseGoal:
    """Return the goal of a pose (4, 4) of the tool in world."""
    return m.PoseGoal(pose=matrix_to_pose(T))
