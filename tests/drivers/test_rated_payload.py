"""Payloads above the rating of a real arm, by command and in the robot file, without the vendors' libraries."""

import sys
from types import ModuleType

import numpy as np
import pytest

from common.config import load_cell
from common.errors import ConfigError
from common.hardware.backends import load_hardware
from common.hardware.driven_arm import DrivenArm
from common.hardware.driver_process import DriverProcess
from common.hardware.interface import Limits

RATED = {"ur3": 3, "ur5": 5, "ur10": 10, "ur3e": 3, "ur5e": 5, "ur7e": 7.5, "ur10e": 12.5, "ur12e": 12.5, "ur15": 15,
         "ur16e": 16, "ur20": 20, "ur30": 35, "franka": 3}


def load(model: str, *more: str) -> DrivenArm:
    """Create the arm of a cell, in a simulated world."""
    backend, options = ("franka", []) if model == "franka" else ("ur", [f"robot.hardware.options.model={model}"])
    robot = load_cell("panda" if backend == "franka" else "ur5", [
        f"robot.hardware.backend={backend}", "robot.hardware.options.host=10.0.0.1",
        "robot.hardware.options.world=simulated", *options, *more]).robot
    ones = np.ones(len(robot.joints))
    return load_hardware(robot, Limits(tuple(robot.joints), -ones, ones, ones, ones), 0 * ones)


@pytest.fixture(autouse=True)
def sent(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Messages to the driver process, which does not run."""
    sent: list[tuple[object, ...]] = []
    for library in ("rtde_control", "pylibfranka"):
        monkeypatch.setitem(sys.modules, library, ModuleType(library))
    monkeypatch.setattr(DriverProcess, "keep_running", lambda _process: None)
    monkeypatch.setattr(DriverProcess, "send", lambda _process, message: sent.append(message) or True)
    return sent


@pytest.mark.parametrize(("model", "limit"), RATED.items())
def test_payload_above_the_rating_is_rejected_with_value_and_limit(
    model: str, limit: float, sent: list[tuple[object, ...]]
) -> None:
    arm = load(model)
    outcome = arm.outcome(arm.order("payload", limit + 0.1, 0.0, 0.0, 0.0)) or ""
    assert f"{limit + 0.1:g} kg exceeds the limit of {limit:g} kg" in outcome and "\n" not in outcome
    assert not sent
    arm.order("payload", limit, 0.0, 0.0, 0.0)
    assert [message[2:4] for message in sent] == [("payload", limit)]


@pytest.mark.parametrize("gripper", [[], ["robot.gripper.hardware={backend: robotiq, options: {host: 10.0.0.1}}"]])
def test_gripper_heavier_than_the_rating_is_rejected_at_the_start(gripper: list[str]) -> None:
    load("ur5e", "robot.gripper.payload={mass: 5}")
    with pytest.raises(ConfigError, match=r"robot.gripper.payload.mass: 5.1 exceeds the rated payload .* 5 kg"):
        load("ur5e", "robot.gripper.payload={mass: 5.1}", *gripper)
