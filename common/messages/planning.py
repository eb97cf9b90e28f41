"""Asking for a plan, and the answer."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from common.messages.basics import MAX_STAMP, SMALL_BYTES, Count, Finite, Fraction, Header, Label, Message, Name, Text
from common.messages.geometry import Pose, Vector3
from common.messages.robot import TRAJECTORY_BYTES, Joints, JointTrajectory
from common.messages.scene import Pairs

_THINNEST = 1e-3  # [m]


class JointGoal(Message):
    """Joint positions to end at [rad], in the order of the robot's group; or the name of a named pose."""

    kind: Literal["joints"] = "joints"
    positions: Joints = []
    named: Label = Field("", description="a named pose of the robot file, such as home; used when positions is empty")


class PoseGoal(Message):
    """A pose for the tool centre point, with a region about it for planners that can use one.

    The straight-line planner ends at the pose itself. Sampling planners may end anywhere in the region: a box with
    the sides `position_tolerance` [m] centred on the pose, tilted by at most `tilt_tolerance` [rad] from the pose's
    tool axis and turned about it by at most `yaw_tolerance` [rad]. An arm of fewer than six joints, which cannot choose
    tilt and yaw, may use up both of these on straight lines as well, and ends them at the place of the pose.
    """

    kind: Literal["pose"] = "pose"
    pose: Pose
    position_tolerance: Vector3 = Vector3()
    tilt_tolerance: Annotated[float, Field(ge=0, le=math.pi)] = 0.0
    yaw_tolerance: Annotated[float, Field(ge=0, le=math.pi)] = 0.0


class PathGoal(Message):
    """Poses for the tool centre point to pass in straight lines, in order, from the first, which is where it starts.

    `tool_speed` is kept wherever joint limits and corners allow; without one the path is as fast as limits allow.
    """

    kind: Literal["path"] = "path"
    waypoints: list[Pose] = Field(min_length=1, max_length=20000)
    step: Annotated[float, Field(gt=0, le=0.1)] | None = Field(
        None, description="way between poses for which joint positions are solved [m]; None: the planner's"
    )
    min_fraction: Fraction | None = Field(None, description="less of the path is refused; None: the planner's")
    tool_speed: Annotated[float, Field(ge=1e-5, le=5)] | None = Field(None, description="[m/s]")


class ArcGoal(Message):
    """A pose that the tool centre point reaches on a circular arc from where it starts.

    The circle is told by a point `via` which the arc passes, or by its `center`; then the shorter arc is taken. The
    orientation turns evenly along it.
    """

    kind: Literal["arc"] = "arc"
    pose: Pose
    via: Vector3 | None = Field(None, description="a point that the arc passes [m]")
    center: Vector3 | None = Field(None, description="of the circle [m]")

    @model_validator(mode="after")
    def _tells_one_circle(self) -> ArcGoal:
        if (self.via is None) == (self.center is None):
            raise ValueError("an arc has either via or center")
        return self


class GoalSet(Message):
    """Several goals of which any will do, such as all grasps of an object.

    With `straight` it is the one at the end of the shortest line that can be followed; else the one that the arm can
    turn straight to in the least time; where obstacles are in the way of all, the one of the best of the attempts.
    """

    kind: Literal["any"] = "any"
    goals: list[Annotated[JointGoal | PoseGoal, Field(discriminator="kind")]] = Field(min_length=1, max_length=100)


class SequenceItem(Message):
    """One motion of a sequence: point to point, a straight line where `straight`, an arc for an arc goal.

    The tool rounds the corner to the next item off within `blend_radius` of this goal; with none it stops there.
    Where the goal leaves some freedom, it is reached where the whole motion takes the least time that was found.
    """

    goal: Annotated[JointGoal | PoseGoal | ArcGoal | GoalSet, Field(discriminator="kind")]
    straight: bool = False
    blend_radius: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="[m]")


class SequenceGoal(Message):
    """Goals to reach one after the other, in one trajectory."""

    kind: Literal["sequence"] = "sequence"
    items: list[SequenceItem] = Field(min_length=1, max_length=200)

    @model_validator(mode="after")
    def _stops_at_the_end(self) -> SequenceGoal:
        if self.items[-1].blend_radius:
            raise ValueError(f"the last item has blend_radius {self.items[-1].blend_radius:g}, but nothing follows it")
        return self


AnyGoal = JointGoal | PoseGoal | PathGoal | ArcGoal | SequenceGoal | GoalSet


class Box(Message):
    """A box: the pose of its middle, and its full sides [m]."""

    pose: Pose
    size: Vector3

    @model_validator(mode="after")
    def _has_sides(self) -> Box:
        if (least := min(self.size.x, self.size.y, self.size.z)) < _THINNEST:
            raise ValueError(f"a box has a side of {least:g} m, {_THINNEST:g} m is the least")
        return self


class PathConstraints(Message):
    """What is kept to all along the way, the start and the goal included.

    `tilt`: the direction `tool_axis` of the tool's frame leans by at most this angle from `axis` in world: the tool's z
    axis from straight down, unless told. With `upright_at_start` the tool stands upright at the start, whatever of it
    lies along `axis` there: a glass held from the side. `region`: the tool centre point stays inside. `tool_speed`:
    it never moves faster.
    """

    tilt: Annotated[float, Field(ge=0.005, le=math.pi)] | None = Field(None, description="[rad]")
    axis: Vector3 = Field(Vector3(z=-1.0), description="of any length")
    tool_axis: Vector3 = Field(Vector3(z=1.0), description="of any length")
    upright_at_start: bool = False
    region: Box | None = None
    tool_speed: Annotated[float, Field(ge=1e-5, le=5)] | None = Field(None, description="[m/s]")

    @model_validator(mode="after")
    def _tells_directions(self) -> PathConstraints:
        for name, axis in (("axis", self.axis), ("tool_axis", self.tool_axis)):
            if not 1e-6 < (length := math.hypot(axis.x, axis.y, axis.z)) < 1e6:
                raise ValueError(f"{name} has length {length:g}, and so no direction")
        return self


class PlanRequest(Message):
    """Ask for a trajectory. Poses are in the robot's base frame, `world`.

    `attach` names an object of the planning scene that is to be planned with as if it were already held (or as held
    now); `release` plans as if nothing were held. Contact that an attached object has at the start is allowed until
    the tool has moved `contact_distance`.
    """

    max_bytes: ClassVar[int] = 4 * 1024 * 1024  # a path of 20000 poses
    max_parts: ClassVar[int] = 128 * 1024

    header: Header = Header()
    id: Name
    stage: Label = Field("", description="what the motion is for: appears in every error")
    start: Joints = Field([], description="joint positions [rad]; empty: where the robot is now")
    goal: Annotated[AnyGoal, Field(discriminator="kind")]
    straight: bool = Field(False, description="only a straight line of the tool will do")
    allowed_collisions: Pairs = Field([], description="in addition to the planning scene's")
    attach: Label = ""
    attach_pose: Pose | None = Field(None, description="of the attached object in the tool frame, when not held yet")
    release: bool = False
    contact_distance: Annotated[float, Field(ge=0, le=0.2)] = 0.02
    constraints: PathConstraints | None = Field(None, description="of the way, whoever plans it")
    gripper_width: Annotated[float, Field(ge=0, le=0.2)] | None = Field(
        None, description="between the fingers on the way, the widest where they move [m]; else as they stand now"
    )
    velocity_scaling: Annotated[float, Field(ge=1e-4, le=1)] | None = None
    acceleration_scaling: Annotated[float, Field(ge=1e-4, le=1)] | None = None
    planning_time: Annotated[float, Field(gt=0, le=600)] | None = Field(None, description="wall time [s]")
    planning_attempts: Annotated[int, Field(ge=1, le=100)] | None = None
    planner: Label = Field("", description="use only this one, of the pipeline or of the project")
    seed: int | None = None

    @model_serializer(mode="wrap")
    def _written(self, write: SerializerFunctionWrapHandler) -> Any:
        """The fields; those that came later only where there are some, so that who knows none can read the rest."""
        fields: dict[str, Any] = write(self)
        for name in ("constraints", "gripper_width"):
            if getattr(self, name) is None:
                fields.pop(name, None)
        return fields


class PlanAttempt(Message):
    """One try of one planner. `error` is empty for a success."""

    planner: Label
    seconds: Finite
    error: Label = ""
    message: Text = ""
    fraction: Finite = 0.0
    waypoint: Count | None = None
    colliding: tuple[Label, Label] | None = None


class PlanResponse(Message):
    """A trajectory, or the error of the planner that got furthest. All attempts are listed."""

    max_bytes: ClassVar[int] = TRAJECTORY_BYTES + 64 * SMALL_BYTES  # with all that was tried
    max_parts: ClassVar[int] = 128 * 1024
    omitted_defaults: ClassVar[tuple[str, ...]] = ("scene_stamp",)

    header: Header = Header()
    id: Name
    ok: bool
    trajectory: JointTrajectory | None = None
    planner: Label = ""
    goal_index: Count = Field(0, description="which goal of a set is reached, from 0; of a sequence, of its last")
    seconds: Finite = Field(0.0, description="wall time [s] of the whole request")
    scene_stamp: Annotated[int, Field(ge=0, le=MAX_STAMP)] = Field(
        0, description="of the planning scene that it was planned on; 0: not known")
    fraction: Finite = 0.0
    error: Label = Field("", description="code: start_in_collision, no_ik, collision, incomplete, timeout, ...")
    message: Text = Field("", description="one line naming stage, planner, waypoint and colliding pair")
    colliding: tuple[Label, Label] | None = None
    attempts: list[PlanAttempt] = Field([], max_length=1000)
