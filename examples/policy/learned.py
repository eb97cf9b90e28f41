"""The learned policy of this folder as a function, for a cell file that has no path of it."""

from functools import cache
from pathlib import Path

from applications.policy.interface import Chunk, Observation
from applications.policy.sources.onnx_file import OnnxPolicy
from applications.policy.sources.settings import PolicyCell, SourceConfig
from common.config import load_cell

NETWORK = Path(__file__).with_name("pick_ball.onnx")


async def policy(observation: Observation) -> Chunk:
    """Return the next second of the pick."""
    return await _network().infer(observation)


@cache
def _network() -> OnnxPolicy:
    robot = load_cell("policy_panda").robot
    cell = PolicyCell(robot.joints, ("camera",), (96, 96), robot.gripper.max_width)
    return OnnxPolicy(SourceConfig(onnx=str(NETWORK)), cell)
