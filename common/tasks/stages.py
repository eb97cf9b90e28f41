"""Stages of a task's queue, their execution by the controllers, and the view of the cell that a task decides by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, Self

from common import messages as m
from common.robot.transforms import matrix_to_pose, pose_to_matrix

Place = tuple[float, float, float]
Goal = m.AnyGoal
Command = m.PlanRequest | m.ExecuteRequest | m.GripperCommand | m.StopRequest | m.HoldRequest | m.IoSet
Report = m.MotionStatus | m.GripperState

OVER = ("succeeded", "aborted", "cancelled")
MISSES = ("too_wide", "too_narrow", "empty")  # outcomes of a grasp that took nothing or something unexpected
FARTHEST = 1e4  # [m] objects farther away or larger than this are ignored
STEADY = 0.2  # [s] change of a camera clock's lead that is reported again
FREE = 0.01  # [m] opening beyond the held width at which a released object falls freely


@dataclass(eq=False)
class Cycle:
    """What several stages belong to, for example one object. An application adds what it must remember."""

    subject: str = ""  # name in the status
    started: bool = False


@dataclass(eq=False)
class Stage:
    """An element of the queue; `state` and `name` are reported in the status while it runs."""

    name: str
    state: str
    cycle: Cycle | None = None
    carries: bool = field(default=False, kw_only=True)  # something must be held from start to end


@dataclass(eq=False)
class Move(Stage):
    """A motion of the arm; planning sets `trajectory` and the other results.

    If no plan is found, the stages in `fallback` replace it, for example one motion for each goal of a sequence.
    """

    goal: Goal = field(kw_only=True)
    straight: bool = field(default=False, kw_only=True)
    touches: list[tuple[str, str]] = field(default_factory=list, kw_only=True)  # pairs that may touch during the motion
    attach: str = field(default="", kw_only=True)  # id of the carried object; empty: the one in the gripper
    attach_pose: m.Pose | None = field(default=None, kw_only=True)  # in the tool frame, while it is not held yet
    needs_fresh_image: bool = field(default=False, kw_only=True)  # starts only while images arrive
    needs_full_plan: bool = field(default=False, kw_only=True)  # starts only once all motions of its cycle are planned
    fallback: list[Stage] = field(default_factory=list, kw_only=True)
    # Digital signals that must have these values from start to end: the arm does not start, or is held on its path.
    requires: Mapping[str, bool] = field(default_factory=dict, kw_only=True)
    start_at: int = field(default=0, kw_only=True)  # cell time at which the arm starts [ns]; 0: at once
    tool_speed: float | None = field(default=None, kw_only=True)  # highest speed of the tool [m/s]
    may_touch: list[str] = field(default_factory=list, kw_only=True)  # what another arm carries, for a handover
    trajectory: m.JointTrajectory | None = field(default=None, init=False)
    planned_around: list[tuple[float, float]] = field(default_factory=list, init=False)  # (x, y) of objects [m]
    planned_width: float | None = field(default=None, init=False)  # finger width during the motion [m]
    plan: str = field(default="", init=False)  # id of the request that the trajectory answers
    scene_stamp: int = field(default=0, init=False)  # of the planning scene used [ns]

    def execution(self, name: str) -> m.ExecuteRequest:
        """Return the request with an id that executes it once it is planned."""
        assert self.trajectory is not None
        return m.ExecuteRequest(
            id=name, trajectory=self.trajectory, plan=self.plan, scene_stamp=self.scene_stamp,
            start_at=self.start_at, may_touch=self.may_touch)

    def end(self) -> list[float]:
        """Joint positions at its end [rad]; empty without a plan."""
        return self.trajectory.points[-1].positions if self.trajectory else []

    @property
    def seconds(self) -> float:
        """Planned duration, cell time [s]."""
        return self.trajectory.points[-1].time_from_start if self.trajectory else 0.0


@dataclass(eq=False)
class Grip(Stage):
    """A motion of the fingers to a width [m]; `holds`: whether an object must be held at its end.

    A held object must have the expected width, if that is known; `problem` describes the difference.
    """

    width: float = field(kw_only=True)
    holds: bool | None = field(default=None, kw_only=True)
    expected_width: float | None = field(default=None, kw_only=True)  # [m]
    width_tolerance: float = field(default=0.01, kw_only=True)  # of expected_width [m]
    early: bool = field(default=False, kw_only=True)  # may start before the arm is at standstill
    lead: float = field(default=0.0, kw_only=True)  # of an early one: before the end of the motion [s]; 0: late
    effort: float = field(default=0.0, kw_only=True)  # [N]; 0: the gripper's default
    mass: float = field(default=0.0, kw_only=True)  # of the object held then [kg]; 0: unknown
    problem: str = field(default="the fingers closed on nothing", init=False)

    def width_after(self, before: float) -> float:
        """Largest possible finger width at its end [m], given the width before."""
        if not self.holds:
            return self.width
        return before if self.expected_width is None else min(self.expected_width + self.width_tolerance, before)


@dataclass(eq=False)
class AwaitImage(Stage):
    """Only a later image may decide what follows, with its objects confirmed; images up to here are outdated."""

    name: str = "look"
    state: str = ""


@dataclass(eq=False)
class Execution:
    """A started stage: `command` was sent and may have been accepted. Times are cell time [s].

    Time counts in proportion to the speed scaling, and not while the arm is held.
    """

    stage: Stage
    command: m.ExecuteRequest | m.GripperCommand
    counted: float  # time up to which `moving` and `spent` are counted
    before: str = ""  # id of the goal that the controller reported at the start
    moving: float = 0.0  # time in motion
    spent: float = 0.0  # time scaled to full speed; time limits compare with this
    accepted: int | None = None  # stamp of the answer that accepted it; older reports do not include it
    started: bool = True  # False while it waits for the arm
    held: float | None = None  # finger width at the start while holding an object [m]
    over: Report | None = None  # answer that already reported the end, because the request was repeated

    @property
    def moves_arm(self) -> bool:
        """Whether the arm moves, not the fingers."""
        return isinstance(self.command, m.ExecuteRequest)

    def count(self, now: float, motion: m.MotionStatus) -> None:
        """Count the time up to now."""
        passed, self.counted = max(0.0, now - self.counted), max(now, self.counted)
        if self.moves_arm and motion.held:
            return
        self.moving += passed
        self.spent += passed * (motion.speed_scaling if self.moves_arm else 1.0)

    def accept(self, answer: Report) -> bool:
        """Handle the answer to the command; return whether it was accepted."""
        if answer.state != "rejected":
            self.accepted = max(self.accepted or 0, answer.header.stamp)
        if answer.state in OVER:
            self.over = answer
        return answer.state != "rejected"

    def motion_ended(self, motion: m.MotionStatus, gripper: m.GripperState) -> None:
        """Update a waiting gripper command once the motion it waits for has ended.

        A report of the same time already includes the result.
        """
        if self.accepted is not None and gripper.id in (self.before, self.command.id):  # no other client commanded it
            self.accepted = max(self.accepted, motion.header.stamp - 1)
        self.started = self.started or (gripper.id == self.command.id and gripper.state != "cancelled")

    def outcome(self, motion: m.MotionStatus, gripper: m.GripperState) -> Literal["running", "ended", "forgotten"]:
        """Return what the controllers report; "forgotten" once an accepted goal is replaced by another."""
        reported = self.report(motion, gripper)
        if reported.id == self.command.id:
            return "ended" if reported.state in OVER else "running"
        later = self.accepted is not None and reported.header.stamp > self.accepted
        return "forgotten" if later else "running"

    def has_released(self, gripper: m.GripperState) -> bool:
        """Return whether opening fingers are already clear of the released object."""
        if self.held is None or gripper.id != self.command.id or gripper.state != "active" or gripper.holding:
            return False
        return isinstance(self.stage, Grip) and self.stage.holds is False and gripper.width >= self.held + FREE

    def report(self, motion: m.MotionStatus, gripper: m.GripperState) -> Report:
        """Return the controller's report; the recorded answer when the controller already reports a later goal."""
        reported = motion if self.moves_arm else gripper
        return self.over if self.over is not None and reported.id not in (self.command.id, self.before) else reported


def _is_near(thing: m.CollisionObject) -> bool:
    return max(*map(abs, place_of(thing.pose)), *thing.dimensions) <= FARTHEST


def within_range(scene: m.PlanningScene) -> m.PlanningScene:
    """Return the scene without objects too far away or too large for any motion."""
    objects = [thing for thing in scene.objects if _is_near(thing)]
    attached = [thing for thing in scene.attached if _is_near(thing.object)]
    if len(objects) + len(attached) == len(scene.objects) + len(scene.attached):
        return scene
    return scene.model_copy(update={"objects": objects, "attached": attached})


@dataclass
class View:
    """What a task knows at one time, from perception and reports only. An application adds the topics it reads.

    `now` and stamps are cell time [s]; `q` joint positions [rad]; `tcp` pose of the tool in world.
    """

    now: float
    scene: m.PlanningScene | None = None
    gripper: m.GripperState | None = None
    motion: m.MotionStatus | None = None
    q: list[float] | None = None
    tcp: m.Pose | None = None
    trouble: str = ""  # why no motion may start
    io: m.IoState | None = None  # None also while its service is gone
    blocked: str = ""  # why the running motion must not continue: a signal that it requires

    def __post_init__(self) -> None:
        """Drop objects that are out of range."""
        if self.scene is not None:
            self.scene = within_range(self.scene)

    def signal(self, name: str) -> bool | float | None:
        """Return the value of an input or output; None while it is unknown or its backend is lost."""
        found = self.io.find(name) if self.io is not None and not self.io.problem(name) else None
        return found.value if found is not None else None

    @property
    def missing(self) -> list[str]:
        """Topics without a message yet; nothing can be decided before."""
        known = {"gripper/state": self.gripper, "planning_scene": self.scene, "joint_states": self.q,
                 "motion/status": self.motion}
        return [key for key, value in known.items() if value is None]

    @property
    def stamps(self) -> tuple[float, ...]:
        """Times of the newest images [s], one for each source that the task decides by."""
        return (self.scene_stamp,)

    @property
    def scene_stamp(self) -> float:
        """Time of the newest image in the planning scene [s]."""
        return self.scene.header.stamp * 1e-9 if self.scene else 0.0

    @property
    def settled_stamp(self) -> float:
        """Time of the newest image whose objects are all in the planning scene [s]."""
        settled = self.scene.settled if self.scene else None
        return self.scene_stamp if settled is None else settled * 1e-9

    @property
    def tool(self) -> Place:
        """Position of the tool center point in world [m]; the origin while unknown."""
        return place_of(self.tcp) if self.tcp else (0.0, 0.0, 0.0)

    @property
    def attached(self) -> str:
        """Id of the held object in the planning scene; empty for none."""
        return self.scene.attached[0].object.id if self.scene and self.scene.attached else ""

    @property
    def holding(self) -> bool:
        """Whether the gripper reports a held object."""
        return self.gripper is not None and self.gripper.holding

    def released(self) -> Self:
        """Return the view after opening the fingers: a held object stays where it is."""
        gripper = self.gripper and self.gripper.model_copy(update={"holding": False})
        if self.scene is None or self.tcp is None:
            return replace(self, gripper=gripper)
        T_world_tcp = pose_to_matrix(self.tcp)
        left = [
            item.object.model_copy(update={
                "role": "target", "pose": matrix_to_pose(T_world_tcp @ pose_to_matrix(item.object.pose))})
            for item in self.scene.attached
        ]
        scene = self.scene.model_copy(update={"objects": [*self.scene.objects, *left], "attached": []})
        return replace(self, gripper=gripper, scene=scene)

    def objects(self, role: str) -> list[m.CollisionObject]:
        """Return the objects of the planning scene with a role."""
        return [o for o in self.scene.objects if o.role == role] if self.scene else []


def place_of(pose: m.Pose) -> Place:
    """Position of a pose [m]."""
    return pose.position.x, pose.position.y, pose.position.z


class ImageAge:
    """Checks the age of images by their stamps. Tolerances are wall time [s], stamps cell time [s]."""

    def __init__(self, speed: float) -> None:
        """Check in a cell whose time runs `speed` times as fast as wall time."""
        self._speed = speed
        self._ahead: float | None = None  # last reported lead of the camera clock [s, wall]

    def problem(self, now: float, stamps: tuple[float, ...], frame_timeout: float, clock_tolerance: float) -> str:
        """Return why images cannot be used to decide; empty when they can.

        Wall-time delays grow with the speed of the cell.

        Args:
            now: cell time.
            stamps: times of the newest images, one for each source.
            frame_timeout: age from which an image is too old.
            clock_tolerance: lead from which a camera clock is unusable.
        """
        ahead = (max(stamps) - now) / self._speed
        if ahead > clock_tolerance:
            if self._ahead is None or abs(ahead - self._ahead) > STEADY:  # else every image would change the message
                self._ahead = ahead
            return f"the camera's clock is {self._ahead:.1f} s ahead"
        self._ahead = None
        return "" if now - min(stamps) < frame_timeout * self._speed else "no fresh picture"


class DwellTimer:
    """Measures for how long the same reason has been given without interruption."""

    def __init__(self) -> None:
        """Start without a reason."""
        self._since: tuple[object, float] | None = None

    def elapsed(self, reason: object, now: float) -> float:
        """Return the time since this reason was first given [s]; another reason restarts the timer."""
        if self._since is None or self._since[0] != reason:
            self._since = reason, now
        return now - self._since[1]

    def reset(self) -> None:
        """Restart the timer."""
        self._since = None
