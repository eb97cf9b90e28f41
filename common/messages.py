"""Every message that travels between services: SI units, quaternions x, y, z, w, names as in ROS where ROS has one.

All models refuse unknown fields and numbers that are not finite. A pose is that of the named thing in
`header.frame_id`. Stamps are cell time in ns since the Unix epoch and are taken once, when the frame is exposed.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

SCHEMA_VERSION = 1

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=120)]


class Message(BaseModel):
    """Base of everything that is sent."""

    model_config = ConfigDict(extra="forbid")


class Header(Message):
    """When and in which frame."""

    stamp: int = Field(0, ge=0, description="cell time [ns since the Unix epoch]")
    frame_id: str = ""


# --- geometry ---------------------------------------------------------------------------------------------------


class Vector3(Message):
    """A point, displacement [m] or box size [m]."""

    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0


class Quaternion(Message):
    """A unit quaternion; refused when its norm is more than 1e-3 off one."""

    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0
    w: Finite = 1.0

    @model_validator(mode="after")
    def _is_unit(self) -> Quaternion:
        norm = math.sqrt(self.x**2 + self.y**2 + self.z**2 + self.w**2)
        if abs(norm - 1) > 1e-3:
            raise ValueError(f"quaternion has norm {norm:.4f}, not 1")
        return self


class Pose(Message):
    """Position [m] and orientation."""

    position: Vector3 = Vector3()
    orientation: Quaternion = Quaternion()


class PoseArray(Message):
    """Poses of several things; `ids[i]` and `labels[i]`, where given, belong to `poses[i]`."""

    header: Header = Header()
    poses: list[Pose] = []
    ids: list[str] = []
    labels: list[str] = Field([], description="scene_balls: table, held, falling, box, or elsewhere (out of sight)")

    @model_validator(mode="after")
    def _same_length(self) -> PoseArray:
        for field in ("ids", "labels"):
            count = len(getattr(self, field))
            if count not in (0, len(self.poses)):
                raise ValueError(f"{field} has {count} entries for {len(self.poses)} poses")
        return self


class TransformStamped(Message):
    """Pose of `child_frame_id` in `header.frame_id`."""

    header: Header
    child_frame_id: Name
    transform: Pose


class TFMessage(Message):
    """Transforms of one instant."""

    transforms: list[TransformStamped]


# --- camera -----------------------------------------------------------------------------------------------------


class Image(Message):
    """Pixels, row by row. `step` is the row stride in bytes; 0 means unpadded. See common/perception/image.py."""

    header: Header
    height: int = Field(ge=1, le=16384)
    width: int = Field(ge=1, le=16384)
    encoding: str = Field(description="bgr8, rgb8, mono8, 16UC1 or 32FC1")
    is_bigendian: bool = False
    step: int = Field(0, ge=0)
    data: bytes


class CameraInfo(Message):
    """Pinhole calibration, as sensor_msgs/CameraInfo: `k` is the 3x3 intrinsic matrix [px], row by row."""

    header: Header
    height: int = Field(ge=1, le=16384)
    width: int = Field(ge=1, le=16384)
    distortion_model: str = "plumb_bob"
    d: list[Finite] = []
    k: list[Finite] = Field(min_length=9, max_length=9)

    @model_validator(mode="after")
    def _has_focal_lengths(self) -> CameraInfo:
        if self.k[0] <= 0 or self.k[4] <= 0:
            raise ValueError(f"focal lengths must be positive, not {self.k[0]:g} and {self.k[4]:g}")
        return self


class Color(Message):
    """Red, green, blue and opacity, each 0 to 1."""

    r: Fraction = 1.0
    g: Fraction = 1.0
    b: Fraction = 1.0
    a: Fraction = 1.0


class Marker(Message):
    """Something to look at: a detection or a shape for the operator. `scale` is the full size [m]."""

    ns: str
    id: int
    type: Literal["sphere", "cylinder", "box", "text"]
    pose: Pose
    scale: Vector3
    color: Color = Color()
    text: str = ""
    pixel: tuple[Finite, Finite] | None = Field(None, description="where the centre is seen, (u, v) [px]")
    partial: bool = Field(False, description="touches the border of the picture: not wholly in view")


class MarkerArray(Message):
    """Markers of one instant; a later message with the same header frame replaces them all."""

    header: Header
    markers: list[Marker]


class Rejection(Message):
    """A detected object that is not offered to the task, and why."""

    position: Vector3
    reason: str


class Rejections(Message):
    """Rejections that are new: one is sent once for each place."""

    header: Header
    rejected: list[Rejection]


# --- planning scene ---------------------------------------------------------------------------------------------


class CollisionObject(Message):
    """A solid in the planning scene.

    `dimensions` [m]: box (x, y, z), sphere (radius,), cylinder (radius, length along z), prism (length along z). A
    prism has the convex hull of `outline` [m] as its cross-section and, as all shapes, its pose at half its length.
    """

    id: Name
    role: Literal["fixture", "container", "target", "contained", "attached"]
    shape: Literal["box", "sphere", "cylinder", "prism"]
    dimensions: list[Positive] = Field(min_length=1, max_length=3)
    outline: list[tuple[Finite, Finite]] = Field([], description="cross-section of a prism [m], in its own frame")
    pose: Pose
    color: Color = Color()

    @model_validator(mode="after")
    def _dimensions_fit_shape(self) -> CollisionObject:
        wanted = {"box": 3, "sphere": 1, "cylinder": 2, "prism": 1}[self.shape]
        if (self.shape == "prism") != (len(self.outline) >= 3):
            raise ValueError(f"a {self.shape} has {len(self.outline)} points of an outline")
        if len(self.dimensions) != wanted:
            raise ValueError(f"a {self.shape} has {wanted} dimensions, not {len(self.dimensions)}")
        return self


class AttachedObject(Message):
    """A solid that moves with the robot: `object.pose` is its pose in the frame of `link`."""

    link: Name
    object: CollisionObject


class PlanningScene(Message):
    """What the planner avoids, all of it perceived or fixed; poses of `objects` are in `header.frame_id`."""

    header: Header
    objects: list[CollisionObject] = []
    attached: list[AttachedObject] = []
    allowed_collisions: list[tuple[str, str]] = Field([], description="pairs of link or object names that may touch")


# --- robot ------------------------------------------------------------------------------------------------------


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


# --- planning requests ------------------------------------------------------------------------------------------


class JointGoal(Message):
    """Joint positions to end at [rad], in the order of the robot's group; or the name of a named pose."""

    kind: Literal["joints"] = "joints"
    positions: list[Finite] = []
    named: str = Field("", description="a named pose of the robot file, such as home; used when positions is empty")


class PoseGoal(Message):
    """A pose for the tool centre point, with a region about it for planners that can use one.

    The straight-line planner ends at the pose itself. Sampling planners may end anywhere in the region: a box with
    the sides `position_tolerance` [m] centred on the pose, tilted by at most `tilt_tolerance` [rad] from the pose's
    tool axis and turned about it by at most `yaw_tolerance` [rad].
    """

    kind: Literal["pose"] = "pose"
    pose: Pose
    position_tolerance: Vector3 = Vector3()
    tilt_tolerance: Annotated[float, Field(ge=0, le=math.pi, allow_inf_nan=False)] = 0.0
    yaw_tolerance: Annotated[float, Field(ge=0, le=math.pi, allow_inf_nan=False)] = 0.0


class PathGoal(Message):
    """Poses for the tool centre point to pass in straight lines, in order, from the first, which is where it starts.

    `tool_speed` is kept wherever joint limits and corners allow; without one the path is as fast as limits allow.
    """

    kind: Literal["path"] = "path"
    waypoints: list[Pose] = Field(min_length=1, max_length=20000)
    step: Annotated[float, Field(gt=0, le=0.1, allow_inf_nan=False)] | None = Field(
        None, description="way between poses for which joint positions are solved [m]; None: the planner's"
    )
    min_fraction: Fraction | None = Field(None, description="less of the path is refused; None: the planner's")
    tool_speed: Annotated[float, Field(gt=0, le=5, allow_inf_nan=False)] | None = Field(None, description="[m/s]")


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


class SequenceItem(Message):
    """One motion of a sequence: point to point, a straight line where `straight`, an arc for an arc goal.

    The tool rounds the corner to the next item off within `blend_radius` of this goal; with none it stops there.
    """

    goal: Annotated[JointGoal | PoseGoal | ArcGoal, Field(discriminator="kind")]
    straight: bool = False
    blend_radius: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = Field(0.0, description="[m]")


class SequenceGoal(Message):
    """Goals to reach one after the other, in one trajectory."""

    kind: Literal["sequence"] = "sequence"
    items: list[SequenceItem] = Field(min_length=1, max_length=200)

    @model_validator(mode="after")
    def _stops_at_the_end(self) -> SequenceGoal:
        if self.items[-1].blend_radius:
            raise ValueError(f"the last item has blend_radius {self.items[-1].blend_radius:g}, but nothing follows it")
        return self


class PlanRequest(Message):
    """Ask for a trajectory. Poses are in the robot's base frame, `world`.

    `attach` names an object of the planning scene that is to be planned with as if it were already held (or as held
    now); `release` plans as if nothing were held. Contact that an attached object has at the start is allowed until
    the tool has moved `contact_distance`.
    """

    header: Header = Header()
    id: Name
    stage: str = Field("", description="what the motion is for: appears in every error")
    start: list[Finite] = Field([], description="joint positions [rad]; empty: where the robot is now")
    goal: Annotated[JointGoal | PoseGoal | PathGoal | ArcGoal | SequenceGoal, Field(discriminator="kind")]
    straight: bool = Field(False, description="only a straight line of the tool will do")
    allowed_collisions: list[tuple[str, str]] = Field([], description="in addition to the planning scene's")
    attach: str = ""
    attach_pose: Pose | None = Field(None, description="of the attached object in the tool frame, when not held yet")
    release: bool = False
    contact_distance: Annotated[float, Field(ge=0, le=0.2, allow_inf_nan=False)] = 0.02
    velocity_scaling: Annotated[float, Field(gt=0, le=1)] | None = None
    acceleration_scaling: Annotated[float, Field(gt=0, le=1)] | None = None
    planning_time: Annotated[float, Field(gt=0, le=600)] | None = Field(None, description="wall time [s]")
    planning_attempts: Annotated[int, Field(ge=1, le=100)] | None = None
    planner: str = Field("", description="use this planner of the pipeline only")
    seed: int | None = None


class PlanAttempt(Message):
    """One try of one planner. `error` is empty for a success."""

    planner: str
    seconds: Finite
    error: str = ""
    message: str = ""
    fraction: Finite = 0.0
    waypoint: int | None = None
    colliding: tuple[str, str] | None = None


class PlanResponse(Message):
    """A trajectory, or the error of the planner that got furthest. All attempts are listed."""

    header: Header = Header()
    id: Name
    ok: bool
    trajectory: JointTrajectory | None = None
    planner: str = ""
    seconds: Finite = Field(0.0, description="wall time [s] of the whole request")
    fraction: Finite = 0.0
    error: str = Field("", description="code: start_in_collision, no_ik, collision, incomplete, timeout, ...")
    message: str = Field("", description="one line naming stage, planner, waypoint and colliding pair")
    colliding: tuple[str, str] | None = None
    attempts: list[PlanAttempt] = []


# --- execution --------------------------------------------------------------------------------------------------

GoalState = Literal["none", "rejected", "active", "succeeded", "aborted", "cancelled"]


class ExecuteRequest(Message):
    """Follow a trajectory. The requester mints `id`; the same id never moves the robot twice."""

    id: Name
    trajectory: JointTrajectory


class StopRequest(Message):
    """Bring the robot to rest. An empty id stops whatever runs."""

    id: str = ""
    reason: str = "asked to"


class MotionStatus(Message):
    """State of the newest goal, and the answer to execute and stop."""

    header: Header = Header()
    id: str = ""
    state: GoalState = "none"
    progress: Fraction = 0.0
    error: str = Field("", description="code, such as start_mismatch, limit, path_tolerance, cancelled")
    message: str = ""
    source: str = Field("", description="who said so: the controller by its name, or hardware")


class GripperCommand(Message):
    """Move the fingers to a width [m]. The requester mints `id`; the same id never moves them twice."""

    id: Name
    width: Annotated[float, Field(ge=0, le=0.2, allow_inf_nan=False)]
    effort: Annotated[float, Field(ge=0, le=1e4, description="grip force [N]; 0: as much as the gripper has")] = 0.0


class GripperState(Message):
    """Width between the fingers [m], whether something is between them, and the newest command."""

    header: Header = Header()
    width: Finite = 0.0
    position: Finite = Field(0.0, description="driven joint [rad or m]")
    effort: Finite = Field(0.0, description="what the fingers press with [N]")
    holding: bool = False
    moving: bool = False
    id: str = ""
    state: GoalState = "none"
    message: str = ""
    source: str = Field("", description="name of the gripper's controller")


# --- task -------------------------------------------------------------------------------------------------------

TaskState = Literal["IDLE", "GRASPING", "PLACING", "HOMING", "DONE", "ERROR"]


class TaskCommand(Message):
    """What a person may tell the task."""

    command: Literal["start", "pause", "resume", "stop"]


class TaskStatus(Message):
    """How far a task is, as the answer to a command: every task has more to say in a status of its own."""

    header: Header = Header()
    state: str = "IDLE"
    paused: bool = False
    started: bool = False
    stage: str = ""
    message: str = ""


class PlanFigure(Message):
    """One successful plan, for the summary."""

    planner: str
    seconds: Finite
    fraction: Finite
    attempts: int


class PickPlaceStatus(Message):
    """State and counters of the pick-and-place task."""

    header: Header = Header()
    state: TaskState = "IDLE"
    paused: bool = False
    started: bool = False
    stage: str = ""
    target: str = Field("", description="track id of the object in work")
    placed: int = 0
    targets: int = Field(0, description="objects that the task has seen and may take or has taken")
    failures: int = 0
    retries: int = 0
    skipped: list[Rejection] = Field([], description="validated targets that could not be taken, and why")
    plans: list[PlanFigure] = []
    moving_seconds: Finite = Field(0.0, description="cell time in motion [s]")
    planning_seconds: Finite = Field(0.0, description="wall time spent in plan requests [s]")
    task_seconds: Finite = Field(0.0, description="cell time since the start of the task [s]")
    message: str = ""


# --- world ------------------------------------------------------------------------------------------------------


class SceneUpdate(Message):
    """What happened to an object of the simulated world, as in the seed: "remove:ball_3", "add:ball_3"."""

    header: Header = Header()
    data: str
    pose: Pose | None = None


class WorldEdit(Message):
    """Change the simulated world. `reset` brings the first layout back; `id` may be empty for `add`."""

    op: Literal["add", "move", "remove", "reset"]
    id: str = ""
    position: Vector3 | None = Field(None, description="centre [m]; z is found from what lies there")


class WorldEditReply(Message):
    """The object that was changed and what is in the world now."""

    id: str
    ids: list[str]


# --- outlines ---------------------------------------------------------------------------------------------------


class PointCloud2(Message):
    """Points as rows of little-endian float32 x, y, z and one packed colour, as sensor_msgs/PointCloud2."""

    header: Header
    height: int = Field(ge=1, le=16384)
    width: int = Field(ge=1, le=16384)
    fields: list[str] = ["x", "y", "z", "rgb"]
    point_step: int = Field(16, ge=4, le=256, description="bytes of one point")
    row_step: int = Field(ge=4, description="bytes of one row")
    data: bytes


class Contour(Message):
    """One closed contour in a picture. `pixels` are (u, v) [px], every one along the edge."""

    index: int = Field(ge=0)
    label: Name
    pixels: list[tuple[Finite, Finite]] = Field(min_length=1)
    area: Finite = Field(0.0, description="[px^2]")
    parent: int = Field(-1, description="index of the contour around this one, or -1")
    touches_border: bool = False
    color: Color = Color()


class Contours(Message):
    """All contours of one picture, and the one that was chosen."""

    header: Header
    width: int = Field(ge=1)
    height: int = Field(ge=1)
    contours: list[Contour] = []
    selected: int = Field(-1, description="index of the chosen contour, or -1")
    message: str = ""


class OutlineSelect(Message):
    """Choose an object: the largest that does not touch the border, one of a colour, or one by its index."""

    rule: Literal["auto", "colour", "index"] = "auto"
    index: int | None = Field(None, ge=0)
    colour: str = Field("", description="red, green, blue, yellow, ... of the object's inside")


class OutlineSelection(Message):
    """What was chosen."""

    index: int
    label: str


class OutlinePoints(PoseArray):
    """The outline of the top face of the chosen object, closed: the last point is followed by the first.

    The stamp is that of the picture. Without a chosen object, or when its outline can not be told, there are no poses
    and `message` says why.
    """

    object: str = Field("", description="label of the chosen contour")
    invalid_depth: int = Field(0, ge=0, description="pixels whose depth was filled from neighbours")
    given: bool = Field(False, description="by a file: need not be the outline of anything that was seen")
    message: str = ""


OutlineState = Literal[
    "IDLE", "SELECTING", "PLANNING", "APPROACHING", "TRACING", "RETREATING", "HOMING", "DONE", "ERROR"
]


class OutlineStatus(Message):
    """State and figures of the outline task."""

    header: Header = Header()
    state: OutlineState = "IDLE"
    paused: bool = False
    started: bool = False
    stage: str = ""
    object: str = ""
    points: int = 0
    fraction: Finite = 0.0
    length_m: Finite = 0.0
    closed: bool = False
    invalid_depth: int = Field(0, description="pixels of the contour whose depth was filled from neighbours")
    standoff: Finite = Field(0.0, description="of the tool above the contour [m]")
    failures: int = 0
    plans: list[PlanFigure] = []
    moving_seconds: Finite = 0.0
    planning_seconds: Finite = 0.0
    task_seconds: Finite = 0.0
    message: str = ""


TaskReport = PickPlaceStatus | OutlineStatus  # what the task of a cell says about itself


class WorldObject(Message):
    """A solid of the simulated world, standing upright: its outline [m] in world and its height.

    `outline` is the outer edge of its top face, anticlockwise; `hole` an inner edge, if it has one.
    """

    id: Name
    shape: Literal["box", "cylinder", "prism", "ring"]
    outline: list[tuple[Finite, Finite]] = Field(min_length=3)
    hole: list[tuple[Finite, Finite]] = []
    base: Finite = Field(description="z on which it stands [m]")
    height: Positive
    color: Color = Color()


class WorldObjects(Message):
    """All solids of the simulated world: the truth."""

    header: Header = Header()
    objects: list[WorldObject] = []


# --- processes --------------------------------------------------------------------------------------------------


class ServiceStatus(Message):
    """One process as the supervisor sees it."""

    name: str
    state: Literal["waiting", "starting", "ready", "restarting", "stopping", "stopped", "failed"]
    pid: int | None = None
    restarts: int = 0
    ready_seconds: Finite | None = Field(None, description="wall time from its start to its readiness token [s]")
    message: str = ""


class SupervisorStatus(Message):
    """All processes of the cell."""

    header: Header = Header()
    cell: str
    services: list[ServiceStatus]


class LogLine(Message):
    """A line of a service's log."""

    header: Header = Header()
    service: str
    level: Literal["debug", "info", "warning", "error", "critical"]
    message: str


class ServiceCounters(Message):
    """What a service's transport counted: dropped, refused and handled messages by key."""

    header: Header = Header()
    service: str
    received: dict[str, int] = {}
    dropped: dict[str, int] = Field({}, description="newer message came before this one was read")
    invalid: dict[str, int] = Field({}, description="payloads that did not parse or validate")
    overflow: dict[str, int] = Field({}, description="events lost because the reader fell behind")
