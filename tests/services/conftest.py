import pytest

from common.config import load_cell
from common.robot.model import RobotModel


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return RobotModel.load(load_cell("panda").robot)
