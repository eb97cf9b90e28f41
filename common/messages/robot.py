"""State of the joints and how they are to move."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from common.messages.basics import MAX_JOINTS, SMALL_BYTES, Finite, Header, Message, Name

MAX_SECONDS = 1e6  # of a trajectory
MAX_POINTS = 25_000  # of a trajectory
TRAJECTORY_BYTES = 7 * 1024 * 1024  # so many points of seven joints

Joints = Annotated[list[Finite], Field(max_length=MAX_JOINTS)]


class JointState(Message):
    """Positions [rad or m], velocities [rad/s or m/s] and efforts of named joints."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header
    name: list[Name] = Field(max_length=MAX_JOINTS)
    position: Joints
    velocity: Joints = []
    effort: Joints = []

    @model_validator(mode="after")
    def _same_length(self) -> JointState:
        for field in ("position", "velocity", "effort"):
            count = len(getattr(self, field))
            if count != len(self.name) and (count or field == "position"):
                raise ValueError(f"{field} has {count} entries for {len(self.name)} joints")
        return self


class RobotDescription(Message):
    """What an arm is, for who moves it from outside: `joints` are those of goals and plans, in their order."""

    max_bytes: ClassVar[int] = 4 * SMALL_BYTES

    header: Header = Header()
    joints: list[Name] = Field(max_length=MAX_JOINTS)
    lower: Joints = Field(description="least positions [rad or m]")
    upper: Joints = Field(description="greatest positions [rad or m]")
    velocity: Joints = Field(description="speed limits [rad/s or m/s]")
    tcp: Name = Field(description="frame of the tool centre point, which pose goals are for")
    named_poses: dict[Name, Joints] = Field({}, max_length=200)
    gripper: bool = False
    fingers: list[Name] = Field([], max_length=100, description="links that touch what is grasped")
    gripper_width: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="between open fingers [m]")

    @model_validator(mode="after")
    def _same_length(self) -> RobotDescription:
        for field in ("lower", "upper", "velocity"):
            if len(getattr(self, field)) != len(self.joints):
                raise ValueError(f"{field} has {len(getattr(self, field))} values for {len(self.joints)} joints")
        return self


class JointTrajectoryPoint(Message):
    """State of all joints at a time [s] after the start."""

    time_from_start: Annotated[float, Field(ge=0, le=MAX_SECONDS)]
    positions: Joints
    velocities: Joints
    accelerations: Joints

    @model_validator(mode="after")
    def _same_length(self) -> JointTrajectoryPoint:
        if not len(self.positions) == len(self.velocities) == len(self.accelerations):
            raise ValueError("positions, velocities and accelerations differ in length")
        return self


class JointTrajectory(Message):
    """A timed path of the named joints; the first point is where the robot starts, at time 0."""

    max_bytes: ClassVar[int] = TRAJECTORY_BYTES
    max_parts: ClassVar[int] = 128 * 1024

    header: Header = Header()
    joint_names: list[Name] = Field(min_length=1, max_length=MAX_JOINTS)
    points: list[JointTrajectoryPoint] = Field(max_length=MAX_POINTS)

    @model_validator(mode="after")
    def _dof_fits(self) -> JointTrajectory:
        for index, point in enumerate(self.points):
            if len(point.positions) != len(self.joint_names):
                raise ValueError(f"point {index} has {len(point.positions)} values for {len(self.joint_names)} joints")
        return self
