"""Guesses how an arm is mounted at a table: how far its base is below the top, and which way it faces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from common.planning.ik import controls_full_pose, solve_tool_down_ik
from common.robot.model import RobotModel
from tools.robot_setup.sampling import place

SHOULDER = 0.5  # an arm whose second joint is higher above its base is mounted on the floor [m]
USUAL = 0.7  # height of a table on the floor [m]
HEIGHTS = (0.4, 0.55, 0.7, 0.85, 1.0)  # of tables next to an arm [m]
FACING = (0.0, math.pi / 2, -math.pi / 2, math.pi)  # of a base [rad]
SHARES = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # of the reach: distances of the positions that are tried
AHEAD = (-0.4, 0.0, 0.4)  # their angles [rad]
ABOVE = 0.05  # of the tool at those positions above the table [m]
ENOUGH = 0.4  # of the positions suffice


@dataclass(frozen=True)
class Mount:
    """Height of the table top above the base [m], yaw of the base [rad], and the positions served of those tried."""

    height: float
    yaw: float
    served: int


def find_mount(robot: RobotModel) -> Mount:
    """Return where the table is for an arm whose base is at the origin: the first usual place that it serves."""
    first, second = robot.model.jointPlacements[1], robot.model.jointPlacements[min(2, robot.dof)]
    heights = sorted(HEIGHTS, key=lambda height: abs(height - USUAL))
    heights = [*heights, 0.0] if (first * second).translation[2] > SHOULDER else [0.0, *heights]
    best: Mount | None = None
    for yaw in FACING:
        for height in (*heights, -0.2):
            mount = _serves(robot, height, yaw)
            if mount.served >= ENOUGH * len(SHARES) * len(AHEAD):
                return mount
            best = mount if best is None or mount.served > best.served else best
    assert best is not None
    return best


def _serves(robot: RobotModel, height: float, yaw: float) -> Mount:
    """Return a mount with the number of positions in front of it at which the tool can point down."""
    start, served = (robot.lower + robot.upper) / 2, 0
    rng = np.random.default_rng(0)
    turns = (0.0, math.pi / 2) if controls_full_pose(robot) else (0.0,)
    for share in SHARES:
        for angle in AHEAD:
            at = *place(robot, share * robot.reach, angle - yaw), height + ABOVE
            served += any(solve_tool_down_ik(robot, at, turn, start, rng=rng, restarts=4, iterations=30) is not None
                          for turn in turns)
    return Mount(height, yaw, served)
