"""What a task's row is made of, one stage in the hands of the controllers, and what a task knows when it decides."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, Self

from common import messages as m
from common.robot.transforms import matrix_to_pose, pose_to_matrix

Place = tuple[float, float, float]
Goal = m.AnyGoal
Command = m.PlanRequest | m.ExecuteRequest | m.GripperCommand | m.StopRequest | m.HoldRequest
Report = m.MotionStatus | m.GripperState

OVER = ("succeeded", "aborted", "cancelled")
MISSES = ("too_wide", "too_narrow", "empty")  # outcomes of a grasp that did not take what was expected
FARTHEST = 1e4  # [m] that what a task looks at is away at most, and large
FREE = 0.01  # [m] by which fingers are further apart than about what they held, when it falls as if they stood still


@dataclass(eq=False)
class Cycle:
    """What some stages of a row are for: one object, for example. An application adds what it has to remember."""

    subject: str = ""  # what the status calls it
    started: bool = False


@dataclass(eq=False)
class Stage:
    """A piece of a row: `state` and `name` are what the status says while it lasts."""

    name: str
    state: str
    cycle: Cycle | None = None
    carries: bool = field(default=False, kw_only=True)  # needs something in the hand from its begin to its end


@dataclass(eq=False)
class Move(Stage):
    """A motion of the arm; `trajectory` is there once it was planned, around what stood at `planned_around`.

    Where there is no way, the stages of `otherwise` take its place: such as one motion for each goal of a sequence.
    """

    goal: Goal = field(kw_only=True)
    straight: bool = field(default=False, kw_only=True)
    touches: list[tuple[str, str]] = field(default_factory=list, kw_only=True)  # pairs that may touch in it
    attach: str = field(default="", kw_only=True)  # id of what it carries; empty: of what is in the hand
    attach_pose: m.Pose | None = field(default=None, kw_only=True)  # in the tool's frame, when not held yet
    needs_fresh_image: bool = field(default=False, kw_only=True)  # begins only while pictures come
    needs_full_plan: bool = field(default=False, kw_only=True)  # begins only once all of its cycle is planned
    fallback: list[Stage] = field(default_factory=list, kw_only=True)
    trajectory: m.JointTrajectory | None = field(default=None, init=False)
    planned_around: list[tuple[float, float]] = field(default_factory=list, init=False)  # (x, y) [m]
    planned_width: float | None = field(default=None, init=False)  # between the fingers on the way [m]
    plan: str = field(default="", init=False)  # id of the request that the trajectory answers
    scene_stamp: int = field(default=0, init=False)  # of the planning scene that it was planned on [ns]

    def end(self) -> list[float]:
        """Joint positions [rad] at its end; empty when it is not planned."""
        return self.trajectory.points[-1].positions if self.trajectory else []

    @property
    def seconds(self) -> float:
        """How long it takes, cell time."""
        return self.trajectory.points[-1].time_from_start if self.trajectory else 0.0


@dataclass(eq=False)
class Grip(Stage):
    """A motion of the fingers to a width [m]; `holds` says whether something must be between them at its end.

    What is between them then must be as wide as expected, where that is known; `problem` says how it was not.
    """

    width: float = field(kw_only=True)
    holds: bool | None = field(default=None, kw_only=True)
    expected_width: float | None = field(default=None, kw_only=True)  # [m]
    width_tolerance: float = field(default=0.01, kw_only=True)  # of expected_width [m]
    early: bool = field(default=False, kw_only=True)  # begins by the time that the motion before it comes to rest
    effort: float = field(default=0.0, kw_only=True)  # [N]; 0: the gripper's own default
    mass: float = field(default=0.0, kw_only=True)  # of what is held then [kg]; 0: not known
    problem: str = field(default="the fingers closed on nothing", init=False)

    def width_after(self, before: float) -> float:
        """The most that the fingers may be apart at its end [m], from where they were before."""
        if not self.holds:
            return self.width
        return before if self.expected_width is None else min(self.expected_width + self.width_tolerance, before)


@dataclass(eq=False)
class AwaitImage(Stage):
    """What was seen up to here decides nothing any more: what follows is decided by a later picture."""

    name: str = "look"
    state: str = ""


@dataclass(eq=False)
class Execution:
    """A stage that was begun: `command` was sent and may have been accepted. Times are cell time [s].

    While the arm is held no time counts, and at a share of its speed only that share of it.
    """

    stage: Stage
    command: m.ExecuteRequest | m.GripperCommand
    counted: float  # up to when; from the begin on
    before: str = ""  # id of the goal that its controller told of then
    moving: float = 0.0  # in motion so far
    spent: float = 0.0  # as if the motion were at full speed: what time-outs go by
    accepted: int | None = None  # stamp of the answer that accepted it; an older report knows nothing of it
    started: bool = True  # else it waits for the arm
    held: float | None = None  # between the fingers as it began, where they held something [m]
    over: Report | None = None  # the answer, when it told of the end already: it was asked for more than once

    @property
    def moves_arm(self) -> bool:
        """Whether the arm moves, and not the fingers."""
        return isinstance(self.command, m.ExecuteRequest)

    def count(self, now: float, motion: m.MotionStatus) -> None:
        """Count the time up to now."""
        passed, self.counted = max(0.0, now - self.counted), max(now, self.counted)
        if self.moves_arm and motion.held:
            return
        self.moving += passed
        self.spent += passed * (motion.speed_scaling if self.moves_arm else 1.0)

    def accept(self, answer: Report) -> bool:
        """Take in the answer to the command: whether it was accepted."""
        if answer.state != "rejected":
            self.accepted = max(self.accepted or 0, answer.header.stamp)
        if answer.state in OVER:
            self.over = answer
        return answer.state != "rejected"

    def wait_no_more(self, motion: m.MotionStatus, gripper: m.GripperState) -> None:
        """Fingers that waited for the arm began, or never will, by the time that its end was told of.

        A report of that very time knows it already.
        """
        if self.accepted is not None and gripper.id in (self.before, self.command.id):  # nobody else told them anything
            self.accepted = max(self.accepted, motion.header.stamp - 1)
        self.started = self.started or (gripper.id == self.command.id and gripper.state != "cancelled")

    def outcome(self, motion: m.MotionStatus, gripper: m.GripperState) -> Literal["running", "ended", "forgotten"]:
        """What the controllers say of it; forgotten once they accepted it and tell of another goal."""
        reported = self.report(motion, gripper)
        if reported.id == self.command.id:
            return "ended" if reported.state in OVER else "running"
        later = self.accepted is not None and reported.header.stamp > self.accepted
        return "forgotten" if later else "running"

    def let_go(self, gripper: m.GripperState) -> bool:
        """Whether fingers that go on opening are clear of what they held already."""
        if self.held is None or gripper.id != self.command.id or gripper.state != "active" or gripper.holding:
            return False
        return isinstance(self.stage, Grip) and self.stage.holds is False and gripper.width >= self.held + FREE

    def report(self, motion: m.MotionStatus, gripper: m.GripperState) -> Report:
        """The report of the controller that the command went to; its answer, when it tells of a later goal already."""
        reported = motion if self.moves_arm else gripper
        return self.over if self.over is not None and reported.id not in (self.command.id, self.before) else reported


def _is_near(thing: m.CollisionObject) -> bool:
    return max(*map(abs, place_of(thing.pose)), *thing.dimensions) <= FARTHEST


def within_range(scene: m.PlanningScene) -> m.PlanningScene:
    """The scene without what is so far away, or so large, that no message has room for a motion there."""
    objects = [thing for thing in scene.objects if _is_near(thing)]
    attached = [thing for thing in scene.attached if _is_near(thing.object)]
    if len(objects) + len(attached) == len(scene.objects) + len(scene.attached):
        return scene
    return scene.model_copy(update={"objects": objects, "attached": attached})


@dataclass
class View:
    """What a task knows at an instant: only what was perceived or reported. An application adds what it reads.

    `now` and stamps are cell time [s]; `q` is where the joints are [rad], `tcp` the pose of the tool in world.
    """

    now: float
    scene: m.PlanningScene | None = None
    gripper: m.GripperState | None = None
    motion: m.MotionStatus | None = None
    q: list[float] | None = None
    tcp: m.Pose | None = None
    trouble: str = ""  # why no motion may begin

    def __post_init__(self) -> None:
        """Leave out what no motion is for."""
        if self.scene is not None:
            self.scene = within_range(self.scene)

    @property
    def missing(self) -> list[str]:
        """Topics that have not said anything yet, without which nothing can be done."""
        known = {"gripper/state": self.gripper, "planning_scene": self.scene, "joint_states": self.q,
                 "motion/status": self.motion}
        return [key for key, value in known.items() if value is None]

    @property
    def stamps(self) -> tuple[float, ...]:
        """When the newest picture was taken [s], as each of those says by whom it is decided."""
        return (self.scene_stamp,)

    @property
    def scene_stamp(self) -> float:
        """Time of the newest frame that the planning scene holds [s]."""
        return self.scene.header.stamp * 1e-9 if self.scene else 0.0

    @property
    def tool(self) -> Place:
        """Where the tool centre point is, in world [m]; the origin as long as nobody has said."""
        return place_of(self.tcp) if self.tcp else (0.0, 0.0, 0.0)

    @property
    def attached(self) -> str:
        """Id of the object in the hand according to the planning scene, or an empty string."""
        return self.scene.attached[0].object.id if self.scene and self.scene.attached else ""

    @property
    def holding(self) -> bool:
        """Whether the gripper reports something between its fingers."""
        return self.gripper is not None and self.gripper.holding

    def let_go(self) -> Self:
        """The same, as it will be when the fingers have opened: what moved with the tool stays where it is."""
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
        """Objects of the planning scene with that role."""
        return [o for o in self.scene.objects if o.role == role] if self.scene else []


def place_of(pose: m.Pose) -> Place:
    """The position of a pose [m]."""
    return pose.position.x, pose.position.y, pose.position.z
