"""What a task decides: hooks with defaults, and helpers for them. `common/tasks/engine.py` executes the decisions.

A task of the user implements `decide` and overrides other hooks only where it differs.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from typing import Generic, Literal, TypeVar

from pydantic import BaseModel, Field

from common import messages as m
from common.config import GripperConfig, Io, Parameters, RobotConfig, Run, Tunable
from common.errors import ConfigError
from common.tasks.stages import AwaitImage, Command, DwellTimer, Execution, Grip, ImageAge, Move, Stage, View

V = TypeVar("V", bound=View)

# Rejections that say nothing about the motion itself: the task decides again.
NOT_ITS_FAULT = ("busy", "io_lost", "stale_request", "clock_ahead", "stopped", "not_owner", "too_late")
MOST_FAILURES = 10
PAUSE, LONGEST_PAUSE = 0.25, 2.0  # [s] after the second failure in a row; doubled with each further one
OVERTIME = 30.0  # [s] a motion that takes this much longer than planned is stopped
RETREAT = 0.1  # [m] upwards
MOVED = 0.005  # [m] an object farther than this from every earlier one is new


class TaskConfig(Parameters):
    """Parameters of every task; times are cell time unless they say wall. A task adds parameters and sections."""

    robot: RobotConfig
    run: Run
    io: Io = Io()
    planning_time: Tunable[float] = Field(2.0, gt=0, le=600, description="wall time for one plan [s]")
    frame_timeout: Tunable[float] = Field(
        1.0, ge=0.1, le=60, description="an older picture starts no motion [s, wall time]"
    )
    clock_tolerance: Tunable[float] = Field(
        0.2, ge=0.01, le=10, description="a picture from so far in the future starts no motion: the clocks of camera "
                                         "and task differ [s, wall time]"
    )
    joint_states_timeout: Tunable[float] = Field(
        0.2, ge=0.05, le=60, description="without joint states for so long the arm is held on its path [s, wall time]"
    )
    obstacle_patience: Tunable[float] = Field(
        1.0, ge=0, le=3600, description="an obstacle that blocks a motion for longer has it planned again [s]"
    )


class TaskDecisions(ABC, Generic[V]):
    """Hooks and helpers of a task. Only `decide` has no default."""

    p: TaskConfig
    status: m.TaskStatus

    def __init_subclass__(cls, **given: object) -> None:
        """Reject a private method that would override one of the engine.

        Raises:
            TypeError: names the method.
        """
        super().__init_subclass__(**given)
        for base in cls.__mro__[1:]:
            if base.__module__.startswith(f"{__package__}."):
                for name in vars(cls).keys() & vars(base).keys():
                    if name.startswith("_") and not name.startswith("__"):
                        raise TypeError(f"{cls.__name__}.{name}: {base.__name__} already has a private method of "
                                        "that name; rename yours")

    def __init__(self, config: TaskConfig, status: m.TaskStatus, prefix: str, speed: float = 1.0) -> None:
        """Start with nothing known.

        Args:
            config: parameters; read where they are used, since they may change at runtime.
            status: an empty status.
            prefix: start of every id that this task creates; unique per process.
            speed: cell time per wall time.
        """
        self.p, self.status, self.prefix, self.speed = config, status, prefix, speed
        self.status.started = config.run.autostart
        self.queue: deque[Stage] = deque()
        self.running: Execution | None = None
        self._opening: Execution | None = None  # gripper command whose object is released while the fingers still open
        self._shut = False  # fingers closed on nothing before the arm arrived: open them before the next decision
        self._early: Execution | None = None  # gripper command that waits for the end of the running motion
        self._held_up = False  # the arm was stopped by fingers that closed early: the next ones close at standstill
        self.wait_timer = DwellTimer()
        self.images_after = 0.0  # only a later image may decide [s]
        self._frames = ImageAge(speed)
        self._planning: tuple[Move, str] | None = None
        self._obstructed = DwellTimer()
        self._stopping = False
        self._found = False  # whether the robot state was read, or an operator sent a command
        self._began: float | None = None
        self._minted = 0
        self._failures_in_a_row = self._done_before = 0
        self._again_at = -math.inf  # no new attempt before this time [s]

    # --- hooks -----------------------------------------------------------------------------------------------

    @abstractmethod
    def decide(self, view: V) -> None:
        """Append the next stages to `queue`, or set `status.state` to DONE; called while nothing runs."""

    def decide_ahead(self, running: Stage, view: V) -> None:
        """Append stages that follow the running one, so that they are planned meanwhile."""

    def note(self, view: V) -> None:
        """Update the counters of the status; called in each step."""

    def may_start(self, stage: Stage, view: V) -> bool:
        """Return whether a planned stage may start now; else it waits, or `clear` has emptied the queue."""
        if not isinstance(stage, Move) or not stage.needs_fresh_image:
            return True
        waits = f"{stage.name} waits"
        if unseen := self.unseen(view):
            self.status.message = f"{waits}: {unseen}"
            return False
        if self.status.message.startswith(waits):
            self.status.message = ""
        return True

    def outdated(self, stage: Stage, view: V) -> str:
        """Return why the running motion has no purpose any more; the arm is stopped then. Empty: it has."""
        return ""

    def planned(self, move: Move, response: m.PlanResponse) -> None:
        """Handle the answer to a plan request, successful or not."""

    def succeeded(self, stage: Stage, view: V) -> None:
        """Handle the success of a stage."""

    def missed(self, stage: Grip, view: V) -> None:
        """Handle a grasp that closed on nothing or on an unexpected width: open, back off and look again."""
        self.status.retries += 1
        self.fail(f"{stage.name}: {stage.problem}", view, go_home=False)
        if self.status.state != "ERROR":
            self.queue += [Grip("open", stage.state, width=self.gripper.max_width), *self.back_off(view.released())]

    def forgotten(self, stage: Stage, view: V) -> None:
        """Handle a restarted controller that no longer knows the stage it had started."""
        self.fail(f"{stage.name} was forgotten by the controller", view)

    def displaced(self, stage: Stage, view: V, problem: str) -> None:
        """Handle a robot that is not where the plan starts: moved by hand, or its controller was restarted."""
        self.fail(problem, view, go_home=False)  # it only needs a new plan

    def obstructed(self, stage: Stage, view: V, problem: str) -> None:
        """Handle an obstacle that stays on the path: a held object is carried around it."""
        self.fail(problem, view, go_home=not view.holding)

    def plan_failed(self, move: Move, response: m.PlanResponse, view: V) -> None:
        """Handle a motion without a plan: free the arm from a contact, or go home and decide again."""
        if self.starts_in_contact(move, response):
            self.fail(response.message, view, go_home=False)
            if self.status.state != "ERROR":
                self.queue += self.back_off(view, response.colliding)
        else:
            # The running stage is still valid; what follows is decided again when it has ended.
            self.fail(response.message, view, go_home=self.running is None and move.name != "home")

    def fail(self, message: str, view: V, *, go_home: bool = True) -> None:
        """Count a failure, clear the queue and, where it helps, go home to look again."""
        go_home = go_home and self._early is None  # a started gripper command ends first
        self.clear()
        self.images_after = view.now
        self.status.message = message
        self.status.failures += 1
        self._failures_in_a_row += 1
        if self._failures_in_a_row >= self.failure_limit:
            self.status.state = "ERROR"
            self.status.message = f"{message}; that makes {self._failures_in_a_row} failures in a row"
        elif go_home:
            self.queue += [self.home(view), AwaitImage()]
        if self._failures_in_a_row > 1:  # the known scene may be outdated: wait for a new one
            self._again_at = view.now + min(PAUSE * 2 ** (self._failures_in_a_row - 2), LONGEST_PAUSE)

    def on_restart(self) -> None:
        """Handle a start by the operator after DONE or ERROR."""

    @property
    def memory(self) -> BaseModel | None:
        """State that camera and gripper cannot restore after a restart; replaced by a new object when it changes."""
        return None

    def remember(self, memory: BaseModel) -> None:
        """Continue from the memory of the task before its restart; every task that has a memory defines it."""
        raise TypeError(f"{type(self).__name__} has a memory, but does not define `remember`")

    def home(self, view: V) -> Move:
        """Return the motion to the home pose, from which the cameras see everything, with a held object."""
        return Move("home", "HOMING", goal=m.JointGoal(named="home"), carries=view.holding)

    def back_off(self, view: V, contact: tuple[str, str] | None = None) -> list[Stage]:
        """Return the stages that lead from the current pose, contacts allowed, to the home pose, and look again."""
        return [self.retreat(view, contact), self.home(view), AwaitImage()]

    def retreat(self, view: V, contact: tuple[str, str] | None = None, height: float = RETREAT) -> Move:
        """Return a motion straight up from the tool's position; the gripper may touch objects that it touches now."""
        assert view.tcp is not None
        at = view.tcp.position
        pose = view.tcp.model_copy(update={"position": m.Vector3(x=at.x, y=at.y, z=at.z + height)})
        touches = [(link, thing.id) for link in self.gripper.links for thing in view.objects("target")]
        return Move("retreat", "HOMING", goal=m.PoseGoal(pose=pose), straight=True, carries=view.holding,
                    touches=[*touches, *([contact] if contact else [])])

    def obstacles(self, move: Move, view: V) -> list[tuple[float, float]]:
        """(x, y) [m] of the objects that matter for a motion; a new one has it planned again."""
        subject = move.cycle.subject if move.cycle else ""
        return [(o.pose.position.x, o.pose.position.y) for o in view.objects("target") if o.id != subject]

    def request(self, move: Move, start: list[float], view: V) -> m.PlanRequest:
        """Return the plan request of a motion; an empty `start` means the current joint positions."""
        return m.PlanRequest(
            id=self.new_id(), stage=move.name, start=start, goal=move.goal, straight=move.straight,
            allowed_collisions=move.touches, attach=move.attach or view.attached if move.carries else "",
            attach_pose=move.attach_pose, release=not move.carries, planning_time=self.p.planning_time,
            constraints=m.PathConstraints(tool_speed=move.tool_speed) if move.tool_speed else None,
        )

    def time_limit(self, stage: Stage) -> float:
        """Time after which a stage is stopped [s]."""
        return OVERTIME + (stage.seconds if isinstance(stage, Move) else 0.0)

    @property
    def failure_limit(self) -> int:
        """Number of failures in a row after which the task gives up."""
        return MOST_FAILURES

    @property
    def moved(self) -> float:
        """Distance from every earlier object at which an object is new [m]."""
        return MOVED

    # --- helpers ---------------------------------------------------------------------------------------------

    @property
    def active_stages(self) -> list[Stage]:
        """Stages of arm and gripper that have started; an early gripper command counts once it moves."""
        return [one.stage for one in (self.running, self._early) if one is not None and one.started]

    @property
    def deferred_grip(self) -> str:
        """Name of the gripper stage that was sent before the arm is at standstill; it may have started. Empty: none."""
        return self._early.stage.name if self._early is not None else ""

    @property
    def gripper(self) -> GripperConfig:
        """The robot's gripper.

        Raises:
            ConfigError: the robot has none.
        """
        if self.p.robot.gripper is None:
            raise ConfigError("robot.gripper", ..., "is missing: the task needs a robot with one")
        return self.p.robot.gripper

    def unseen(self, view: V) -> str:
        """Return why the newest image cannot be used to decide; empty when it can."""
        return self._frames.problem(view.now, view.stamps, self.p.frame_timeout, self.p.clock_tolerance)

    def has_fresh_image(self, view: V) -> bool:
        """Return whether the scene shows a usable image after `images_after`; the status reports an unusable one."""
        if unseen := self.unseen(view):
            self.status.message = unseen
        return not unseen and min(*view.stamps, view.settled_stamp) > self.images_after

    def starts_in_contact(self, move: Move, response: m.PlanResponse) -> bool:
        """Return whether a plan failed because the arm touches something at its start; a retreat may free it."""
        collides = response.error == "start_in_collision" and response.colliding is not None
        return collides and self.running is None and move.name != "retreat"

    def end(self, state: Literal["DONE", "ERROR"], message: str = "") -> None:
        """End the task until an operator starts it again."""
        self.clear()
        self.status.state, self.status.stage, self.status.message = state, "", message

    def clear(self) -> None:
        """Empty the queue; the running stage continues."""
        self.queue.clear()
        self._planning = None

    def stop(self, view: V, reason: str, by: Literal["operator", "requester"] = "requester") -> list[Command]:
        """Empty the queue and stop the arm; a started gripper command continues."""
        self.clear()
        self.images_after = view.now
        if self.running is None or not self.running.moves_arm:
            return []
        running, self.running, self._stopping = self.running, None, True
        self.status.moving_seconds += running.moving
        return [m.StopRequest(id=running.command.id, reason=reason, by=by)]

    def new_id(self) -> str:
        """Return a new unique id."""
        self._minted += 1
        return f"{self.prefix}-{self._minted}"
