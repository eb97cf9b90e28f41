"""The UR5 on its pillar next to the block that carries objects."""

import math

import numpy as np

from common.robot.transforms import rpy_to_matrix, transform
from tests.common.planning.scenes import UR5 as ROBOT
from tests.common.planning.scenes import only, solid

HOME = ROBOT.named("home")
TOP = 1.0  # of the block [m]
SCENE = only(solid("robot_base", "fixture", "cylinder", [0.175, 0.75], (0, 0, 0.375)),
             solid("target_base", "fixture", "box", [0.25, 0.75, 1.0], (0.5, 0, 0.5)))


def tip_at(x: float, y: float, z: float) -> np.ndarray:
    """(4, 4) T_world_tcp with the tool pointing down, as while tracing."""
    return transform(rpy_to_matrix(0.0, -math.pi, -math.pi), (x, y, z))
