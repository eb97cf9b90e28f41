"""Messages that move the arm and the gripper, stop and hold them, run the task, and report their states."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.messages.basics import (
    MAX_JOINTS,
    MAX_STAMP,
    SELF_RELEASING,
    SMALL_BYTES,
    UNKNOWN_OPERATOR,
    Count,
    Finite,
    FormerOperator,
    Fraction,
    Header,
    Label,
    Message,
    Name,
    OperatorName,
    Remark,
    Text,
    Vector3,
    either_name,
)
from common.messages.camera import Rejection
from common.messages.robot import TRAJECTORY_BYTES, JointTrajectory

GoalState = Literal["none", "rejected", "active", "succeeded", "aborted", "cancelled"]
GripOutcome = Literal["", "grasped", "too_wide", "too_narrow", "empty", "slipping"]
Holder = Annotated[Literal["operator", "watchdog", "controller", "scene_monitor", "coordinator"],
                   FormerOperator]
OwnerKind = Literal["none", "task", "operator", "script"]
JogFrame = Literal["base", "tool", "world"]
Since = Annotated[int, Field(ge=0, le=MAX_STAMP)]  # [ns since the Unix epoch]
Acknowledged = Annotated[Since | None, Field(validation_alias=either_name("acknowledged"))]
MAX_INTERLOCKS = 32  # in a message
CLOSED_BEFORE = "closed_before"  # error of a motion that was held up after the fingers began to close for its end
NOT_PERSISTED = "not saved on disk"  # prefix of the reason of an interlock that a restart of the executor would lose


class ExecuteRequest(Message):
    """Follow a trajectory. The requester mints `id`; a repeated id never moves the robot twice.

    The stamp of the header is the time of the decision: a request that arrives too late is refused.
    """

    max_bytes: ClassVar[int] = TRAJECTORY_BYTES + SMALL_BYTES
    max_parts: ClassVar[int] = 128 * 1024
    omitted_defaults: ClassVar[tuple[str, ...]] = ("plan", "scene_stamp", "joins", "join_time", "start_at", "may_touch")

    header: Header = Header()
    id: Name
    trajectory: JointTrajectory
    owner: OperatorName = Field(
        "", description="operator who requests it, and whose own stop does not block it; empty for a task")
    acknowledged: Acknowledged = Field(
        None, description="`since` of the newest interlock that the operator has seen: later ones block the motion")
    plan: Label = Field("", description="id of the plan request that returned the trajectory")
    scene_stamp: Since = Field(0, description="stamp of the planning scene it was planned on; 0: unknown")
    joins: Label = Field("", description="id of the goal that is followed and that this one continues; it ends as "
                                         "cancelled with error replaced. Empty: start from rest")
    join_time: Finite = Field(0.0, description="time on the trajectory of that goal at which this one starts, at its "
                                               "position and velocity [s]")
    start_at: Since = Field(0, description="cell time at which the arm starts, at rest until then [ns]; 0: at once")
    may_touch: list[Label] = Field([], max_length=8, description="object that another arm carries and that the gripper "
                                   "may touch, slowly and from near, for a handover; the coordinator decides")


class FollowedRequest(Message):
    """Request the trajectory of the goal that is being followed."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    id: Name


class StopRequest(Message):
    """Bring the robot to rest. An empty id stops any goal.

    By an operator it stops any goal, whatever id it names, and blocks all motion until an operator starts again; that
    persists over restarts. By the requester it ends the named goal only, also a goal that arrives later.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES

    id: Label = ""
    reason: Text = "requested"
    by: Annotated[Literal["operator", "requester"], FormerOperator] = "operator"
    owner: OperatorName = Field("", description="name of the operator")


class HoldRequest(Message):
    """Bring the robot to rest on its path and hold it there, or release a hold. The goal stays active meanwhile.

    Holds of operators persist over restarts. A hold without a name belongs to every operator: any of them releases it.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES
    omitted_defaults: ClassVar[tuple[str, ...]] = ("goal",)

    hold: bool
    reason: Text = ""
    by: Annotated[Literal["operator", "watchdog", "scene_monitor", "coordinator"], FormerOperator] = Field(
        "operator", description="each releases only its own hold; the robot moves when no hold is left")
    goal: Label = Field(
        "", description="hold only while this goal is followed; empty: until released. Not for operators")
    owner: OperatorName = Field("", description="name of the operator: holds of other operators stay")
    stops: bool = Field(False, description="release stops of all operators too: an operator starts the task")
    override: bool = Field(False, description="release the interlocks of all operators; is logged")
    into_stop: bool = Field(
        False, description="turn released holds into stops of the same time: only this operator moves the robot")
    acknowledged: Acknowledged = Field(
        None, description="`since` of the newest interlock that the operator has seen: later ones stay. Without it "
                          "all stops stay")


class Interlock(Message):
    """A reason why the robot does not move: a stop, which blocks new motions, or a hold on its path."""

    kind: Literal["stopped", "held"]
    by: OperatorName = Field(description="name of an operator; watchdog; controller; scene_monitor; "
                                      "coordinator")
    reason: Remark = ""
    since: Since = Field(description="last time it was requested [ns since the Unix epoch], later than all before it")

    @property
    def description(self) -> str:
        """Kind, time, operator and reason in one line."""
        when = datetime.fromtimestamp(self.since * 1e-9, UTC)
        return f"{self.kind} since {when:%Y-%m-%d %H:%M:%S} UTC by {self.by}{self.reason and f' ({self.reason})'}"

    def blocks(self, operator: str) -> bool:
        """Return whether it blocks motions of an operator who knows it; anyone may release a hold without a name."""
        return self.by != operator and self.by not in SELF_RELEASING and (
            self.kind == "stopped" or self.by != UNKNOWN_OPERATOR)


class MotionStatus(Message):
    """State of the newest goal, and the reply to execute, stop and hold."""

    max_bytes: ClassVar[int] = 4 * SMALL_BYTES  # with all interlocks
    max_parts: ClassVar[int] = 256
    omitted_defaults: ClassVar[tuple[str, ...]] = ("fault", "plan", "scene_stamp", "path_time", "force", "distance")

    header: Header = Header()
    id: Label = ""
    state: GoalState = "none"
    progress: Fraction = 0.0
    error: Label = Field("", description="code, such as start_mismatch, limit, path_tolerance, cancelled")
    message: Text = ""
    source: Label = Field("", description="origin of the error: name of the controller, or hardware")
    held: bool = Field(False, description="at rest on its path until released; no new goal starts")
    held_by: list[Holder] = Field([], max_length=8)
    speed_scaling: Fraction = Field(1.0, description="trajectories are followed at this share of their speed")
    interlocks: Annotated[list[Interlock], Field(max_length=MAX_INTERLOCKS)] = Field(
        [], validation_alias=either_name("interlocks"), description="stops and holds in force")
    fault: Text = Field("", description="why the hardware does not move the robot; empty while it does")
    plan: Label = Field("", description="id of the plan request behind the goal, if the requester named it")
    scene_stamp: Since = Field(0, description="stamp of the planning scene it was planned on; 0: unknown")
    path_time: Finite = Field(0.0, description="time of the newest set-point on the trajectory of the goal [s]; "
                                               "negative until it joins the one before")
    force: Finite = Field(0.0, description="of the tool along its direction at the end of a force motion [N]")
    distance: Finite = Field(0.0, description="that the tool went in that direction [m]")

    @property
    def stopped(self) -> str:
        """Descriptions of all stops in one line; empty when motions may start."""
        return "; ".join(each.description for each in self.interlocks if each.kind == "stopped")

    @property
    def unsaved(self) -> str:
        """Descriptions of operators' interlocks that a restart of the executor would lose; empty without any."""
        return "; ".join(each.description for each in self.interlocks if each.reason.startswith(NOT_PERSISTED))

    @property
    def newest(self) -> int:
        """`since` of the newest interlock; 0 without any."""
        return max((each.since for each in self.interlocks), default=0)

    @property
    def paused(self) -> bool:
        """Whether an operator has to release the robot; all other holders release it by themselves."""
        return self.held and (not self.held_by or "operator" in self.held_by)


class GripperCommand(Message):
    """Move the fingers to a width [m]. The requester mints `id`; a repeated id never moves them twice.

    With `expected_width` it is a grasp, which fails if the object is wider or narrower, or missing. The stamp of the
    header is the time of the decision: a command that arrives too late is refused, one without a stamp never is.

    With `after` the fingers wait for the arm, in the arm's own time. They start `lead` before its goal ends, only when
    the tool is not farther than `within` from the end, and not at all if the goal fails. If the arm is held, slowed or
    stalled after they began to close, it does not resume: the fingers may have closed on an object.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES
    omitted_defaults: ClassVar[tuple[str, ...]] = (
        "expected_width", "width_tolerance", "owner", "mass", "acknowledged", "after", "lead", "within")

    header: Header = Header()
    id: Name
    owner: OperatorName = Field("", description="operator who requests it; empty for a task")
    acknowledged: Acknowledged = Field(
        None, description="`since` of the newest interlock that the operator has seen: later ones block the motion")
    width: Annotated[float, Field(ge=0, le=0.2)]
    effort: Annotated[float, Field(ge=0, le=1e4, description="grip force [N]; 0: default of the gripper")] = 0.0
    expected_width: Annotated[float, Field(ge=0, le=0.2)] | None = Field(
        None, description="measured width of the object to grasp [m]")
    width_tolerance: Annotated[float, Field(gt=0, le=0.2, description="of expected_width [m]")] = 0.005
    mass: Annotated[float, Field(ge=0, le=1000)] = Field(0.0, description="of the object to grasp [kg]; 0: unknown")
    after: Label = Field("", description="id of the arm's goal that the fingers wait for; empty: start at once")
    lead: Annotated[float, Field(ge=0, le=10)] = Field(0.0, description="start this long before that goal ends [s]")
    within: Annotated[float, Field(ge=0, le=1)] = Field(
        0.005, description="largest distance of the tool from the end of that goal at the start [m]")


class GripperState(Message):
    """Width between the fingers [m], whether they hold an object, and the newest command.

    `outcome` is the result of a grasp and `message` says it in a line: as expected, wider, narrower, or empty. It is
    slipping when an object was held and then, without a command, the fingers closed further or lost it.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES
    omitted_defaults: ClassVar[tuple[str, ...]] = ("outcome",)

    header: Header = Header()
    width: Finite = 0.0
    position: Finite = Field(0.0, description="driven joint [rad or m]")
    effort: Finite = Field(0.0, description="measured grip force [N]")
    holding: bool = False
    moving: bool = False
    id: Label = ""
    state: GoalState = "none"
    outcome: GripOutcome = ""
    error: Label = Field("", description="code of a refusal, such as stopped")
    message: Text = ""
    source: Label = Field("", description="name of the gripper's controller")


class JogCommand(Message):
    """Move at these velocities of joints or of the tool while the command is repeated. A late one has no effect.

    The arm brakes 0.1 s after the newest command, and is at rest 0.2 s after it. Without velocities it stops at once.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    owner: OperatorName = Field(UNKNOWN_OPERATOR, min_length=1, description="name of the operator who jogs")
    acknowledged: Acknowledged = Field(
        None, description="`since` of the newest interlock that the operator has seen: later ones block the motion")
    joints: Annotated[dict[Name, Finite], Field(max_length=MAX_JOINTS)] = Field(
        {}, description="velocities of joints by name [rad/s, m/s]; other joints stay")
    linear: Vector3 = Field(Vector3(), description="velocity of the TCP [m/s]; not together with joints")
    angular: Vector3 = Field(Vector3(), description="rotation about the TCP [rad/s]; not together with joints")
    frame: JogFrame = Field("base", description="frame of linear and angular")


class OwnRequest(Message):
    """Take or release the ownership of motion. It has one owner at a time; motions of others are refused."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    act: Literal["take", "give"]
    owner: Annotated[Name, FormerOperator] = Field(description="name of an operator, a script or a task")
    kind: Literal["task", "operator", "script"] = "operator"
    over: bool = Field(False, description="take it from its owner, whose motion is stopped; is logged")
    lease: Annotated[float, Field(ge=0, le=86_400, allow_inf_nan=False)] = Field(
        0.0, description="release it after this long without a motion or another take [s, wall]; 0: never")


class MotionOwner(Message):
    """Current owner of motion: motions of others are refused. Stop and hold are open to everyone."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    owner: OperatorName = ""
    kind: OwnerKind = "none"
    since: Since = Field(0, description="[ns since the Unix epoch]")
    asked: bool = Field(False, description="owned until it is released; else for one motion")
    jogging: bool = False

    @property
    def description(self) -> str:
        """Owner, kind and time in one line."""
        if self.kind == "none":
            return "free"
        when = datetime.fromtimestamp(self.since * 1e-9, UTC)
        return f"owned by {self.owner or 'a task'} ({self.kind}) since {when:%Y-%m-%d %H:%M:%S} UTC"


class TaskCommand(Message):
    """Start, pause, resume or stop the task. An operator without a name has no holds of their own."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    command: Literal["start", "pause", "resume", "stop"]
    by: OperatorName = Field("", description="name of the operator")
    override: bool = Field(False, description="start or resume although another operator holds the robot; is logged")
    acknowledged: Acknowledged = Field(
        None, description="`since` of the newest interlock that the operator has seen: later ones stay")


class PlanFigure(Message):
    """One successful plan, for the summary."""

    planner: Label
    seconds: Finite
    fraction: Finite
    attempts: Count


class TaskStatus(Message):
    """Progress of a task, and the reply to a command. Each task derives its own status from this.

    `figures` are the task's own, by name; the summary of a run repeats them.
    """

    max_bytes: ClassVar[int] = 256 * 1024
    max_parts: ClassVar[int] = 8 * 1024

    header: Header = Header()
    state: Label = Field("IDLE", description="DONE and ERROR end a run; IDLE is at rest; others are the task's own")
    paused: bool = False
    started: bool = False
    stage: Label = ""
    subject: Label = Field("", description="current subject, such as the id of an object")
    done: Count = Field(0, description="of `total`")
    total: Count = Field(0, description="what the task has perceived and can do or has done")
    failures: Count = 0
    retries: Count = 0
    skipped: list[Rejection] = Field([], max_length=1000, description="what could not be done, where, and why")
    plans: list[PlanFigure] = Field([], max_length=1000)
    moving_seconds: Finite = Field(0.0, description="cell time in motion [s]")
    planning_seconds: Finite = Field(0.0, description="wall time spent in plan requests [s]")
    task_seconds: Finite = Field(0.0, description="cell time since the start of the task [s]")
    figures: dict[Name, bool | int | Finite | Text | None] = Field({}, max_length=200)
    message: Text = ""
    overlooked: Text = Field("", description="what was perceived and not done when the task ended")
