"""The UR5 on its pillar next to the block that carries objects."""

from __future__ import annotations

import math

import numpy as np

from common.config import RobotConfig, check, find_file, load_cell, read_robot
from common.messages import CollisionObject, Header, JointGoal, PlanningScene, PlanRequest, Pose, PoseGoal, Vector3
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform

CONFIG = check(RobotConfig, read_robot(find_file("robots", "ur5")))
ROBOT = RobotModel.load(CONFIG)
HOME = ROBOT.named("home")
PIPELINE = PlanningPipeline(ROBOT, load_cell("panda").motion, load_cell("panda").pipeline)
TOP = 1.0  # of the block [m]


def solid(name: str, shape: str, dimensions: list[float], z: float, x: float = 0.0) -> CollisionObject:
    pose = Pose(position=Vector3(x=x, y=0.0, z=z))
    return CollisionObject(id=name, role="fixture", shape=shape, dimensions=dimensions, pose=pose)  # type: ignore[arg-type]


SCENE = PlanningScene(
    header=Header(frame_id="world"),
    objects=[
        solid("robot_base", "cylinder", [0.175, 0.75], 0.375),
        solid("target_base", "box", [0.25, 0.75, 1.0], 0.5, x=0.5),
    ],
)


def tip_at(x: float, y: float, z: float) -> np.ndarray:
    """(4, 4) T_world_tcp with the tool pointing down, as while tracing."""
    return transform(rpy_to_matrix(0.0, -math.pi, -math.pi), (x, y, z))


def to_pose(T: np.ndarray, start: np.ndarray, straight: bool = False) -> PlanRequest:
    return PlanRequest(id="1", start=list(start), goal=PoseGoal(pose=matrix_to_pose(T)), straight=straight)


def to_home(start: np.ndarray) -> PlanRequest:
    return PlanRequest(id="1", start=list(start), goal=JointGoal(named="home"))
