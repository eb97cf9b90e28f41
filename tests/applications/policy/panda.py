"""The arm of the tests of policies, and observations of it."""

from functools import cache

import numpy as np

from applications.policy.interface import Observation
from applications.policy.sources.settings import PolicyCell
from common.config.loading import load_robot
from common.robot.model import RobotModel

READY = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
STAMP = 1_000_000_000_000


@cache
def panda() -> RobotModel:
    return RobotModel.load(load_robot("panda"))


def panda_cell(*cameras: str) -> PolicyCell:
    return PolicyCell(panda().joint_names, cameras, (32, 24) if cameras else None, 0.08)


def observation(*cameras: str, positions=READY, gripper=0.06) -> Observation:
    images = {name: np.full((24, 32, 3), 10 * number, np.uint8) for number, name in enumerate(cameras, 1)}
    return Observation(STAMP, np.array(positions), np.zeros(7), panda().fk(positions), gripper, images, "pick the ball",
                       np.zeros((0, 7)))
