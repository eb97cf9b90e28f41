"""Plan requests and their answers."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from common.messages.basics import (
    MAX_STAMP,
    SMALL_BYTES,
    Count,
    Finite,
    Fraction,
    Header,
    Label,
    Message,
    Name,
    Pose,
    Text,
    Vector3,
)
from common.messages.robot import TRAJECTORY_BYTES, Joints, JointTrajectory
from common.messages.scene import Pairs

_MIN_SIDE = 1e-3  # [m]


class JointGoal(Message):
    """Goal joint positions [rad], in the order of the robot's group; or the name of a named pose."""

    kind: Literal["joints"] = "joints"
    positions: Joints = []
    named: Label = Field("", description="a named pose of the robot file, such as home; used when positions is empty")


class PoseGoal(Message):
    """A pose of the tool centre point, with a goal region for planners that can use one.

    The straight-line planner ends at the pose itself. Sampling planners may end anywhere in the region: a box with
    the sides `position_tolerance` [m] centred on the pose, tilted by at most `tilt_tolerance` [rad] from the pose's
    tool axis and turned about it by at most `yaw_tolerance` [rad]. An arm of fewer than six joints, which cannot choose
    tilt and yaw, may use both of these on straight lines as well, and ends them at the position of the pose.
    """

    kind: Literal["pose"] = "pose"
    pose: Pose
    position_tolerance: Vector3 = Vector3()
    tilt_tolerance: Annotated[float, Field(ge=0, le=math.pi)] = 0.0
    yaw_tolerance: Annotated[float, Field(ge=0, le=math.pi)] = 0.0


class PathGoal(Message):
    """Poses that the tool centre point passes in order on straight lines, from the first, where it starts.

    `tool_speed` is held wherever joint limits and corners allow; without it the path is as fast as limits allow.
    """

    kind: Literal["path"] = "path"
    waypoints: list[Pose] = Field(min_length=1, max_length=20000)
    step: Annotated[float, Field(gt=0, le=0.1)] | None = Field(
        None, description="distance between poses with solved joint positions [m]; None: the planner's"
    )
    min_fraction: Fraction | None = Field(None, description="least accepted fraction of the path; None: the planner's")
    tool_speed: Annotated[float, Field(ge=1e-5, le=5)] | None = Field(None, description="[m/s]")


class ArcGoal(Message):
    """A pose that the tool centre point reaches on a circular arc from where it starts.

    The circle is defined by a point `via` on the arc, or by its `center`; then the shorter arc is used. The orientation
    turns evenly along it.
    """

    kind: Literal["arc"] = "arc"
    pose: Pose
    via: Vector3 | None = Field(None, description="a point that the arc passes [m]")
    center: Vector3 | None = Field(None, description="of the circle [m]")

    @model_validator(mode="after")
    def _require_one_circle(self) -> ArcGoal:
        if (self.via is None) == (self.center is None):
            raise ValueError("an arc has either via or center")
        return self


class GoalSet(Message):
    """Alternative goals, such as all grasps of an object.

    With `straight` the planner reaches the one at the end of the shortest feasible line; else the one with the fastest
    direct joint motion; where obstacles block all of these, the one of the best attempt.
    """

    kind: Literal["any"] = "any"
    goals: list[Annotated[JointGoal | PoseGoal, Field(discriminator="kind")]] = Field(min_length=1, max_length=100)


class SequenceItem(Message):
    """One motion of a sequence: point to point, a straight line if `straight`, an arc for an arc goal.

    The tool blends the corner to the next item within `blend_radius` of this goal; without it stops there. A goal with
    freedom is reached where the complete motion takes the least time found.
    """

    goal: Annotated[JointGoal | PoseGoal | ArcGoal | GoalSet, Field(discriminator="kind")]
    straight: bool = False
    blend_radius: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="[m]")


class SequenceGoal(Message):
    """Goals to reach in order, in one trajectory."""

    kind: Literal["sequence"] = "sequence"
    items: list[SequenceItem] = Field(min_length=1, max_length=200)

    @model_validator(mode="after")
    def _require_stop_at_the_end(self) -> SequenceGoal:
        if self.items[-1].blend_radius:
            raise ValueError(f"the last item has blend_radius {self.items[-1].blend_radius:g}, but nothing follows it")
        return self


class MovingGoal(Message):
    """A target that moves evenly, such as an object on a belt: meet it, stay with it for a while, and leave upwards.

    `pose` is that of the tool centre point at the target at the time `stamp`. The arm starts at `begin`, meets a point
    `approach` above the target as early as it can, descends, stays for `dwell`, rises and comes to rest, all while
    it moves with the target. Objects of the scene with a velocity are avoided where they will be.
    """

    kind: Literal["moving"] = "moving"
    pose: Pose
    stamp: Annotated[int, Field(ge=0, le=MAX_STAMP)] = Field(description="cell time of the pose [ns]")
    velocity: Vector3 = Field(description="of the target [m/s]")
    begin: Annotated[int, Field(ge=0, le=MAX_STAMP)] = Field(description="cell time at which the arm starts [ns]")
    approach: Annotated[float, Field(ge=0.01, le=0.5)] = Field(0.1, description="[m]")
    dwell: Annotated[float, Field(ge=0, le=10)] = Field(0.5, description="[s]")
    travel: Annotated[float, Field(ge=0, le=10)] = Field(
        1.0, description="most way of the target from the pose until the arm leaves it [m]")


AnyGoal = JointGoal | PoseGoal | PathGoal | ArcGoal | SequenceGoal | GoalSet | MovingGoal


class Box(Message):
    """A box: the pose of its centre, and its full sides [m]."""

    pose: Pose
    size: Vector3

    @model_validator(mode="after")
    def _require_sides(self) -> Box:
        if (least := min(self.size.x, self.size.y, self.size.z)) < _MIN_SIDE:
            raise ValueError(f"a box has a side of {least:g} m, {_MIN_SIDE:g} m is the least")
        return self


class PathConstraints(Message):
    """Constraints on the complete path, start and goal included.

    `tilt`: largest angle between `tool_axis` in the tool's frame and `axis` in world, by default between the tool's z
    axis and straight down. With `upright_at_start` the tool counts as upright at the start, and the direction in its
    frame that is along `axis` there replaces `tool_axis`: a glass held from the side. `region`: the tool centre point
    stays inside. `tool_speed`: its highest speed.
    """

    tilt: Annotated[float, Field(ge=0.005, le=math.pi)] | None = Field(None, description="[rad]")
    axis: Vector3 = Field(Vector3(z=-1.0), description="of any length")
    tool_axis: Vector3 = Field(Vector3(z=1.0), description="of any length")
    upright_at_start: bool = False
    region: Box | None = None
    tool_speed: Annotated[float, Field(ge=1e-5, le=5)] | None = Field(None, description="[m/s]")

    @model_validator(mode="after")
    def _require_directions(self) -> PathConstraints:
        for name, axis in (("axis", self.axis), ("tool_axis", self.tool_axis)):
            if not 1e-6 < (length := math.hypot(axis.x, axis.y, axis.z)) < 1e6:
                raise ValueError(f"{name} has length {length:g}, and so no direction")
        return self


class PlanRequest(Message):
    """Request a trajectory. Poses are in the robot's base frame, `world`.

    `attach` names an object of the planning scene to plan with as if it were held already; `release` plans as if
    nothing were held. Contact of an attached object at the start is allowed until the tool has moved
    `contact_distance`.
    """

    max_bytes: ClassVar[int] = 4 * 1024 * 1024  # a path of 20000 poses
    max_parts: ClassVar[int] = 128 * 1024

    header: Header = Header()
    id: Name
    stage: Label = Field("", description="purpose of the motion: appears in every error")
    start: Joints = Field([], description="joint positions [rad]; empty: where the robot is now")
    goal: Annotated[AnyGoal, Field(discriminator="kind")]
    straight: bool = Field(False, description="require a straight line of the tool")
    allowed_collisions: Pairs = Field([], description="in addition to those of the planning scene")
    attach: Label = ""
    attach_pose: Pose | None = Field(None, description="of the attached object in the tool frame, if not held yet")
    release: bool = False
    contact_distance: Annotated[float, Field(ge=0, le=0.2)] = 0.02
    constraints: PathConstraints | None = Field(None, description="on the path, for any planner")
    gripper_width: Annotated[float, Field(ge=0, le=0.2)] | None = Field(
        None, description="between the fingers on the path, the widest if they move [m]; None: the current width"
    )
    velocity_scaling: Annotated[float, Field(ge=1e-4, le=1)] | None = None
    acceleration_scaling: Annotated[float, Field(ge=1e-4, le=1)] | None = None
    planning_time: Annotated[float, Field(gt=0, le=600)] | None = Field(None, description="wall time [s]")
    planning_attempts: Annotated[int, Field(ge=1, le=100)] | None = None
    planner: Label = Field("", description="use only this planner of the pipeline or of the project")
    seed: int | None = None

    @model_serializer(mode="wrap")
    def _written(self, write: SerializerFunctionWrapHandler) -> Any:
        """Return the fields; omit unset new ones, so that former versions can read the others."""
        fields: dict[str, Any] = write(self)
        for name in ("constraints", "gripper_width"):
            if getattr(self, name) is None:
                fields.pop(name, None)
        return fields


class PlanAttempt(Message):
    """One attempt of one planner. `error` is empty for a success."""

    planner: Label
    seconds: Finite
    error: Label = ""
    message: Text = ""
    fraction: Finite = 0.0
    waypoint: Count | None = None
    colliding: tuple[Label, Label] | None = None


class PlanResponse(Message):
    """A trajectory, or the error of the planner that got furthest, with all attempts."""

    max_bytes: ClassVar[int] = TRAJECTORY_BYTES + 64 * SMALL_BYTES  # with all attempts
    max_parts: ClassVar[int] = 128 * 1024
    omitted_defaults: ClassVar[tuple[str, ...]] = ("scene_stamp", "meet_time")

    header: Header = Header()
    id: Name
    ok: bool
    trajectory: JointTrajectory | None = None
    planner: Label = ""
    goal_index: Count = Field(0, description="index of the reached goal of a set, from 0; of a sequence: its last set")
    seconds: Finite = Field(0.0, description="wall time [s] of the complete request")
    scene_stamp: Annotated[int, Field(ge=0, le=MAX_STAMP)] = Field(
        0, description="stamp of the planning scene it was planned on; 0: unknown")
    meet_time: Finite = Field(0.0, description="of a moving goal: time on the trajectory when the tool is there [s]")
    fraction: Finite = 0.0
    error: Label = Field("", description="code: start_in_collision, no_ik, collision, incomplete, timeout, ...")
    message: Text = Field("", description="one line naming stage, planner, waypoint and colliding pair")
    colliding: tuple[Label, Label] | None = None
    attempts: list[PlanAttempt] = Field([], max_length=1000)
