"""State of the joints and how they are to move."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from common.messages.basics import Finite, Header, Message, Name


class JointState(Message):
    """Positions [rad or m], velocities [rad/s or m/s] and efforts of named joints."""

    header: Header
    name: list[Name]
    position: list[Finite]
    velocity: list[Finite] = []
    effort: list[Finite] = []

    @model_validator(mode="after")
    def _same_length(self) -> JointState:
        for field in ("position", "velocity", "effort"):
            count = len(getattr(self, field))
            if count != len(self.name) and (count or field == "position"):
                raise ValueError(f"{field} has {count} entries for {len(self.name)} joints")
        return self


class JointTrajectoryPoint(Message):
    """State of all joints at a time [s] after the start."""

    time_from_start: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    positions: list[Finite]
    velocities: list[Finite]
    accelerations: list[Finite]

    @model_validator(mode="after")
    def _same_length(self) -> JointTrajectoryPoint:
        if not len(self.positions) == len(self.velocities) == len(self.accelerations):
            raise ValueError("positions, velocities and accelerations differ in length")
        return self


class JointTrajectory(Message):
    """A timed path of the named joints; the first point is where the robot starts, at time 0."""

    header: Header = Header()
    joint_names: list[Name] = Field(min_length=1)
    points: list[JointTrajectoryPoint]

    @model_validator(mode="after")
    def _dof_fits(self) -> JointTrajectory:
        for index, point in enumerate(self.points):
            if len(point.positions) != len(self.joint_names):
                raise ValueError(f"point {index} has {len(point.positions)} values for {len(self.joint_names)} joints")
        return self
