"""Moving the arm and the fingers, and how far they are."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.messages.basics import (
    MOST_JOINTS,
    MOST_STAMP,
    SMALL,
    Finite,
    Fraction,
    Header,
    Label,
    Message,
    Name,
    Remark,
    Text,
)
from common.messages.geometry import Vector3
from common.messages.robot import TRAJECTORY_BYTES, JointTrajectory

GoalState = Literal["none", "rejected", "active", "succeeded", "aborted", "cancelled"]
GripOutcome = Literal["", "grasped", "too_wide", "too_narrow", "empty", "slipping"]
RobotMode = Literal[
    "disconnected", "off", "idle", "running", "freedrive", "protective_stop", "emergency_stop", "fault"
]
Holder = Literal["person", "watchdog", "controller", "scene_monitor"]
OwnerKind = Literal["none", "task", "operator", "script"]
JogFrame = Literal["base", "tool", "world"]
Who = Label
Since = Annotated[int, Field(ge=0, le=MOST_STAMP)]
MOST_INHIBITS = 32  # that are told of
CLOSED_BEFORE = "closed_before"  # error of a motion for whose end the fingers began to close, and that was held up
NOT_KEPT = "not kept on disk"  # begins the reason of an inhibit that would not outlive its process


class ExecuteRequest(Message):
    """Follow a trajectory. The requester mints `id`; the same id never moves the robot twice.

    The header says when that was decided: a request that comes too late is refused.
    """

    most_bytes: ClassVar[int] = TRAJECTORY_BYTES + SMALL
    most_parts: ClassVar[int] = 128 * 1024
    later: ClassVar[tuple[str, ...]] = ("plan", "scene_stamp")

    header: Header = Header()
    id: Name
    trajectory: JointTrajectory
    owner: Who = Field("", description="the person who asks for it, whom a stop of their own does not keep from moving "
                                       "the robot; empty for a task")
    heard: Since | None = Field(None, description="`since` of the newest inhibit that this person had heard of")
    plan: Label = Field("", description="id of the plan request that was answered with it")
    scene_stamp: Since = Field(0, description="of the planning scene that it was planned on; 0: not known")


class FollowedRequest(Message):
    """Ask for the trajectory of the goal that is followed now."""

    most_bytes: ClassVar[int] = SMALL

    id: Name


class StopRequest(Message):
    """Bring the robot to rest. An empty id stops whatever runs.

    By a person it stops whatever runs, whichever id it names, and no motion begins until one is asked for again: that
    outlives every process. By the requester it ends its goal only. A goal that is named and comes later is refused.
    """

    most_bytes: ClassVar[int] = SMALL

    id: Label = ""
    reason: Text = "asked to"
    by: Literal["person", "requester"] = "person"
    owner: Who = Field("", description="name of the person")


class HoldRequest(Message):
    """Bring the robot to rest on its path and keep it there, or let it go on. The goal stays active meanwhile.

    A person's hold outlives every process. Who gave no name holds for everybody, and everybody lets go of that.
    """

    most_bytes: ClassVar[int] = SMALL
    later: ClassVar[tuple[str, ...]] = ("goal",)

    hold: bool
    reason: Text = ""
    by: Literal["person", "watchdog", "scene_monitor"] = Field(
        "person", description="each lets go only of its own hold; the robot moves when nobody holds it"
    )
    goal: Label = Field("", description="hold only while this goal is followed; empty: until it is let go. Not for "
                                        "persons")
    owner: Who = Field("", description="name of the person: holds of others stay")
    stops: bool = Field(False, description="lets go of stops too, whoever said so: a person starts the task")
    override: bool = Field(False, description="lets go of all that any person said; is logged")
    into_stop: bool = Field(False, description="the holds that it lets go of become stops of the same time: the person "
                                               "moves the robot, and nobody else does")
    heard: Since | None = Field(None, description="lets go of nothing later: `since` of the newest inhibit known")


class Inhibit(Message):
    """Why the robot does not move: it was stopped, and no motion begins, or is held on its path."""

    kind: Literal["stopped", "held"]
    by: Who = Field(description="name of a person; watchdog; controller; scene_monitor")
    reason: Remark = ""
    since: Since = Field(description="when that was said last [ns since the Unix epoch], later than all before it")

    @property
    def told(self) -> str:
        """In words, for a line."""
        when = datetime.fromtimestamp(self.since * 1e-9, UTC)
        return f"{self.kind} since {when:%Y-%m-%d %H:%M:%S} UTC by {self.by}{self.reason and f' ({self.reason})'}"


class MotionStatus(Message):
    """State of the newest goal, and the answer to execute, stop and hold."""

    most_bytes: ClassVar[int] = 4 * SMALL  # with all that keeps the robot from moving
    most_parts: ClassVar[int] = 256
    later: ClassVar[tuple[str, ...]] = ("fault", "plan", "scene_stamp")

    header: Header = Header()
    id: Label = ""
    state: GoalState = "none"
    progress: Fraction = 0.0
    error: Label = Field("", description="code, such as start_mismatch, limit, path_tolerance, cancelled")
    message: Text = ""
    source: Label = Field("", description="who said so: the controller by its name, or hardware")
    held: bool = Field(False, description="kept at rest on its path until let go; no new goal begins to move")
    held_by: list[Holder] = Field([], max_length=8)
    speed_scaling: Fraction = Field(1.0, description="trajectories are followed at this share of their speed")
    inhibits: Annotated[list[Inhibit], Field(max_length=MOST_INHIBITS)] = Field(
        [], description="who stopped or holds the robot")
    fault: Text = Field("", description="why the hardware does not move the robot, while that is so")
    plan: Label = Field("", description="id of the plan request that the goal answers, where it was told")
    scene_stamp: Since = Field(0, description="of the planning scene that it was planned on; 0: not known")

    @property
    def stopped(self) -> str:
        """By whom and since when no motion begins, in words; empty when one may."""
        return "; ".join(inhibit.told for inhibit in self.inhibits if inhibit.kind == "stopped")

    @property
    def not_kept(self) -> str:
        """What a person decided and would be lost with the executor, in words; empty when there is nothing."""
        return "; ".join(inhibit.told for inhibit in self.inhibits if inhibit.reason.startswith(NOT_KEPT))

    @property
    def newest(self) -> int:
        """`since` of the newest inhibit; 0 when there is none."""
        return max((inhibit.since for inhibit in self.inhibits), default=0)

    @property
    def paused(self) -> bool:
        """Whether somebody has to let go of the robot: all but persons do so by themselves."""
        return self.held and (not self.held_by or "person" in self.held_by)


class GripperCommand(Message):
    """Move the fingers to a width [m]. The requester mints `id`; the same id never moves them twice.

    With `expected_width` it is a grasp, which fails where what is held is wider or narrower, or nothing is. The header
    says when it was decided: a command that comes too late is refused; one without a stamp never is.

    With `after` the fingers wait for the arm, by the arm's own time: they begin `lead` before it is there, though no
    farther away than `within`, and not at all where it does not arrive. An arm that is held, slowed or stalls once
    they have begun to close does not go on with what they may have closed about.
    """

    most_bytes: ClassVar[int] = SMALL
    later: ClassVar[tuple[str, ...]] = (
        "expected_width", "width_tolerance", "owner", "mass", "heard", "after", "lead", "within")

    header: Header = Header()
    id: Name
    owner: Who = Field("", description="who asks for it; empty for a task")
    heard: Since | None = Field(None, description="`since` of the newest inhibit that this person had heard of")
    width: Annotated[float, Field(ge=0, le=0.2)]
    effort: Annotated[float, Field(ge=0, le=1e4, description="grip force [N]; 0: the gripper's own default")] = 0.0
    expected_width: Annotated[float, Field(ge=0, le=0.2)] | None = Field(
        None, description="of what is to be between the fingers, such as it was seen [m]"
    )
    width_tolerance: Annotated[float, Field(gt=0, le=0.2, description="of expected_width [m]")] = 0.005
    mass: Annotated[float, Field(ge=0, le=1000)] = Field(0.0, description="of what is to be held [kg]; 0: not known")
    after: Label = Field("", description="id of the arm's goal that the fingers wait for; empty: for none")
    lead: Annotated[float, Field(ge=0, le=10)] = Field(0.0, description="before the end of that [s]")
    within: Annotated[float, Field(ge=0, le=1)] = Field(0.005, description="of where the tool is then [m]")


class GripperState(Message):
    """Width between the fingers [m], whether something is between them, and the newest command.

    `outcome` says what became of a grasp, `message` says it in a line: what is held is as expected, or wider, narrower,
    nothing; slipping when it was held and then, without a command, the fingers closed on or it was lost.
    """

    most_bytes: ClassVar[int] = SMALL
    later: ClassVar[tuple[str, ...]] = ("outcome",)

    header: Header = Header()
    width: Finite = 0.0
    position: Finite = Field(0.0, description="driven joint [rad or m]")
    effort: Finite = Field(0.0, description="what the fingers press with [N]")
    holding: bool = False
    moving: bool = False
    id: Label = ""
    state: GoalState = "none"
    outcome: GripOutcome = ""
    error: Label = Field("", description="code of a refusal, such as stopped")
    message: Text = ""
    source: Label = Field("", description="name of the gripper's controller")


class RobotStatus(Message):
    """What the arm's own controller says: whether it could be moved, by whom, and how well time is kept."""

    later: ClassVar[tuple[str, ...]] = ("controller",)

    header: Header = Header()
    mode: RobotMode
    message: Text = Field("", description="why it cannot be moved; empty while it can")
    speed: Fraction = Field(1.0, description="share at which the arm's own slider lets it move")
    late: Finite = Field(0.0, description="the latest cycle of its driver so far [s]")
    inputs: int = Field(0, ge=0, lt=2**32, description="digital inputs, a bit each")
    outputs: int = Field(0, ge=0, lt=2**32, description="digital outputs, a bit each")
    controller: bool = Field(False, description="whether the arm has one of its own, which takes robot/command")


class RobotCommand(Message):
    """Have the arm's own controller do something that is no motion.

    The header says when that was decided: one that comes too late is refused; one without a stamp never is.
    """

    most_bytes: ClassVar[int] = SMALL

    later: ClassVar[tuple[str, ...]] = ("header", "output", "com")

    header: Header = Header()
    act: Literal["enable", "recover", "freedrive", "payload", "output"] = Field(
        description="enable: power and brakes; recover: from a protective stop; freedrive: moved by hand, value 1 or "
                    "0; payload: what the tool carries, value in kg; output: a digital output, value 1 or 0"
    )
    value: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 0.0
    output: int = Field(0, ge=0, lt=32, description="which one")
    com: Vector3 = Field(Vector3(), description="centre of mass of the payload, from the flange [m]")
    owner: Who = Field("", description="name of the person")

    @property
    def values(self) -> tuple[float, ...]:
        """What the arm's driver is told beside the act."""
        if self.act == "payload":
            return self.value, self.com.x, self.com.y, self.com.z
        return (self.value, float(self.output)) if self.act == "output" else (self.value,)


class JogCommand(Message):
    """Move while this comes again and again: velocities of joints, or of the tool. One that comes late does nothing.

    The arm brakes 0.1 s after the newest one, and stands 0.2 s after it. All left out: it comes to rest at once.
    """

    most_bytes: ClassVar[int] = SMALL

    header: Header = Header()
    owner: Who = Field("person", min_length=1, description="name of who jogs")
    heard: Since | None = Field(None, description="`since` of the newest inhibit that this person had heard of")
    joints: Annotated[dict[Name, Finite], Field(max_length=MOST_JOINTS)] = Field(
        {}, description="velocities of joints by their names [rad/s, m/s]; the others rest")
    linear: Vector3 = Field(Vector3(), description="velocity of the TCP [m/s]; not beside joints")
    angular: Vector3 = Field(Vector3(), description="rotation of the tool about the TCP [rad/s]; not beside joints")
    frame: JogFrame = Field("base", description="whose axes linear and angular are along")


class OwnRequest(Message):
    """Ask for the motion of the robot, or give it back. It has one owner at a time, and nobody else's motion begins."""

    most_bytes: ClassVar[int] = SMALL

    act: Literal["take", "give"]
    owner: Name = Field(description="name of a person, a script or a task")
    kind: Literal["task", "operator", "script"] = "operator"
    over: bool = Field(False, description="take it from whoever has it: their motion is stopped; is logged")
    lease: Annotated[float, Field(ge=0, le=86_400, allow_inf_nan=False)] = Field(
        0.0, description="give it back after so long without a motion or another take [s, wall]; 0: never")


class MotionOwner(Message):
    """Whose motion it is: nobody else's begins. Stops and holds are everybody's."""

    most_bytes: ClassVar[int] = SMALL

    header: Header = Header()
    owner: Who = ""
    kind: OwnerKind = "none"
    since: Since = Field(0, description="[ns since the Unix epoch]")
    asked: bool = Field(False, description="taken until it is given back; else for one motion")
    jogging: bool = False

    @property
    def told(self) -> str:
        """In words, for a line."""
        if self.kind == "none":
            return "nobody's"
        when = datetime.fromtimestamp(self.since * 1e-9, UTC)
        return f"{self.owner or 'a task'}'s ({self.kind}) since {when:%Y-%m-%d %H:%M:%S} UTC"
