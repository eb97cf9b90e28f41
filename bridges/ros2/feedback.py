"""Feedback of FollowJointTrajectory: where the trajectory is, where the arm is, and the difference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bridges.ros2 import convert
from bridges.ros2.graph import Graph
from bridges.ros2.keys import Qos
from bridges.ros2.trajectories import violation
from bridges.ros2.types import FOLLOW, INDEXED, JAZZY, make
from common.control.trajectory import Trajectory
from common.hardware.interface import Vector
from common.messages import JointState

POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
QOS = Qos(depth=10)


class Feedback:
    """Publishes feedback of the running goal under one name, for both definitions of its type."""

    def __init__(self, graph: Graph, name: str) -> None:
        """Declare the publishers: a subscription has one of the two hashes, by its version of control_msgs."""
        self._publishers = {
            variant: graph.publisher(name, f"{FOLLOW}_FeedbackMessage", QOS, variant) for variant in (JAZZY, INDEXED)}
        self._uuid, self._names = b"", list[str]()
        self._trajectory: Trajectory | None = None

    def start(self, uuid: bytes, names: Sequence[str], trajectory: Trajectory) -> None:
        """Give feedback of this goal from now on, for joints in the order of the trajectory."""
        self._uuid, self._names, self._trajectory = uuid, list(names), trajectory

    def publish(self, header: Any, state: JointState, progress: float, tolerances: dict[str, float]) -> str:
        """Publish the feedback at a share of the trajectory; return which joint is beyond its tolerance, or nothing."""
        assert self._trajectory is not None
        time = progress * self._trajectory.duration
        (q, dq), (actual, velocities) = self._trajectory.at(time), self._ordered(state)
        index = int(np.searchsorted(self._trajectory.times, time, side="right")) - 1
        for variant, publisher in self._publishers.items():
            if not publisher.matched:
                continue
            indices = {"index": index} if variant == INDEXED else {}
            feedback = make(
                f"{FOLLOW}_Feedback", variant, header=header, joint_names=self._names, desired=_point(time, q, dq),
                actual=_point(time, actual, velocities), error=_point(time, q - actual, dq - velocities), **indices)
            publisher.put(make(
                f"{FOLLOW}_FeedbackMessage", variant, goal_id=convert.uuid_of(self._uuid), feedback=feedback))
        return violation(self._names, q, actual, tolerances)

    def end_violation(self, state: JointState | None, tolerances: dict[str, float]) -> str:
        """Return which joint is beyond its tolerance at the end of the trajectory, or nothing."""
        if state is None or self._trajectory is None or not tolerances:
            return ""
        return violation(self._names, self._trajectory.positions[-1], self._ordered(state)[0], tolerances)

    def _ordered(self, state: JointState) -> tuple[Vector, Vector]:
        """Return positions and velocities (dof,) in the order of the trajectory."""
        order = [state.name.index(name) for name in self._names]
        velocities = state.velocity or [0.0] * len(state.name)
        return np.array([state.position[i] for i in order]), np.array([velocities[i] for i in order])


def _point(time: float, positions: Vector, velocities: Vector) -> Any:
    return make(POINT, positions=np.ascontiguousarray(positions), velocities=np.ascontiguousarray(velocities),
                time_from_start=convert.duration_of(time))
