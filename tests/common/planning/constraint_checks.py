"""Constraints judged apart from the code that keeps to them: pinocchio's kinematics at every millisecond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from common.messages import PlanResponse
from common.planning.retiming import sample
from common.planning.validation import timed_path
from common.robot.model import RobotModel


@dataclass(frozen=True)
class Way:
    """What the tool does at every millisecond: places (N, 3) [m], axes (N, 3), speeds (N,) [m/s]."""

    places: np.ndarray
    axes: np.ndarray
    speeds: np.ndarray

    def tilt(self, axis=(0.0, 0.0, -1.0)) -> float:
        """The most [rad] by which the tool's z axis leans from an axis."""
        return float(np.arccos(np.clip(self.axes @ np.array(axis), -1, 1)).max())

    def outside(self, middle, size) -> float:
        """The most [m] by which the tool is outside a box that stands straight."""
        return float((np.abs(self.places - middle) - np.array(size) / 2).max())


def driven(robot: RobotModel, response: PlanResponse) -> Way:
    """The way of the tool as the controller drives it."""
    assert response.ok, response.message
    trajectory = timed_path(response.trajectory)
    times = np.append(np.arange(0.0, trajectory.duration, 1e-3), trajectory.duration)
    model, data = robot.model, robot.model.createData()
    frame = model.getFrameId(robot.config.tcp_link)
    poses = []
    for q in sample(trajectory, times):
        pin.framesForwardKinematics(model, data, q)
        poses.append(data.oMf[frame].homogeneous.copy())
    poses = np.array(poses)
    speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.diff(times)
    return Way(poses[:, :3, 3], poses[:, :3, 2], speeds)
