"""Messages about the arm: joint states, trajectories, its description, and its own controller."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from common.messages.basics import (
    MAX_JOINTS,
    SMALL_BYTES,
    Finite,
    Fraction,
    Header,
    Label,
    Message,
    Name,
    OperatorName,
    Text,
    Vector3,
)

MAX_SECONDS = 1e6  # of a trajectory
MAX_POINTS = 25_000  # of a trajectory
TRAJECTORY_BYTES = 7 * 1024 * 1024  # of a trajectory with that many points of seven joints

Joints = Annotated[list[Finite], Field(max_length=MAX_JOINTS)]
RobotMode = Literal[
    "disconnected", "off", "idle", "running", "freedrive", "protective_stop", "emergency_stop", "fault"
]


class JointState(Message):
    """Positions [rad or m], velocities [rad/s or m/s] and efforts of named joints."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header
    name: list[Name] = Field(max_length=MAX_JOINTS)
    position: Joints
    velocity: Joints = []
    effort: Joints = []

    @model_validator(mode="after")
    def _require_same_length(self) -> JointState:
        for field in ("position", "velocity", "effort"):
            count = len(getattr(self, field))
            if count != len(self.name) and (count or field == "position"):
                raise ValueError(f"{field} has {count} entries for {len(self.name)} joints")
        return self


class SetPoints(Message):
    """What was commanded in one control cycle: positions of the arm's joints [rad or m], width of the gripper [m].

    The stamp is that of the joint states of the cycle. The width is that of the newest command; None before the first.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header
    name: list[Name] = Field(max_length=MAX_JOINTS)
    position: Joints
    width: Finite | None = None

    @model_validator(mode="after")
    def _require_same_length(self) -> SetPoints:
        if len(self.position) != len(self.name):
            raise ValueError(f"position has {len(self.position)} entries for {len(self.name)} joints")
        return self


class RobotDescription(Message):
    """Description of an arm for its clients: `joints` are those of goals and plans, in their order."""

    max_bytes: ClassVar[int] = 4 * SMALL_BYTES

    omitted_defaults: ClassVar[tuple[str, ...]] = ("flange",)

    header: Header = Header()
    joints: list[Name] = Field(max_length=MAX_JOINTS)
    lower: Joints = Field(description="lower position limits [rad or m]")
    upper: Joints = Field(description="upper position limits [rad or m]")
    velocity: Joints = Field(description="velocity limits [rad/s or m/s]")
    tcp: Name = Field(description="frame of the tool centre point, which pose goals are for")
    flange: Label = Field("", description="frame of the flange, from which payloads are given")
    named_poses: dict[Name, Joints] = Field({}, max_length=200)
    gripper: bool = False
    fingers: list[Name] = Field([], max_length=100, description="links that touch a grasped object")
    gripper_width: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="between the open fingers [m]")

    @model_validator(mode="after")
    def _require_same_length(self) -> RobotDescription:
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
    def _require_same_length(self) -> JointTrajectoryPoint:
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
    def _require_dof(self) -> JointTrajectory:
        for index, point in enumerate(self.points):
            if len(point.positions) != len(self.joint_names):
                raise ValueError(f"point {index} has {len(point.positions)} values for {len(self.joint_names)} joints")
        return self


class RobotStatus(Message):
    """State of the arm's own controller: its mode, speed slider, timing and digital inputs and outputs."""

    omitted_defaults: ClassVar[tuple[str, ...]] = ("controller", "resumed")

    header: Header = Header()
    mode: RobotMode
    message: Text = Field("", description="why the arm cannot move; empty while it can")
    speed: Fraction = Field(1.0, description="share of the speed that the arm's own slider allows")
    late: Finite = Field(0.0, description="largest delay of a cycle of its driver so far [s]")
    inputs: int = Field(0, ge=0, lt=2**32, description="digital inputs, one bit each")
    outputs: int = Field(0, ge=0, lt=2**32, description="digital outputs, one bit each")
    controller: bool = Field(False, description="whether the arm has a controller that accepts robot/command")
    resumed: int = Field(0, ge=0, description="interruptions of motions so far, by delays of its driver or executor "
                                              "or by the slider, after which they continued")


class RobotCommand(Message):
    """Command the arm's own controller to do something other than a motion.

    The stamp of the header is the time of the decision: a command that arrives too late is refused, one without a
    stamp never is.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES

    omitted_defaults: ClassVar[tuple[str, ...]] = ("header", "output", "com")

    header: Header = Header()
    act: Literal["enable", "recover", "freedrive", "payload", "output"] = Field(
        description="enable: power and brakes, not in a safety stop; recover: from a safety stop, without powering; "
                    "freedrive: move by hand, value 1 or 0; payload: mass carried by the tool, value in kg; output: a "
                    "digital output, value 1 or 0")
    value: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 0.0
    output: int = Field(0, ge=0, lt=32, description="number of the digital output")
    com: Vector3 = Field(Vector3(), description="centre of mass of the payload, from the flange [m]")
    owner: OperatorName = Field("", description="name of the operator")

    @property
    def values(self) -> tuple[float, ...]:
        """Arguments of the act for the arm's driver."""
        if self.act == "payload":
            return self.value, self.com.x, self.com.y, self.com.z
        return (self.value, float(self.output)) if self.act == "output" else (self.value,)
