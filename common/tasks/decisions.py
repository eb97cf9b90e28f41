"""What a task decides, with the usual answer to each question; `common/tasks/engine.py` does what was decided.

A task of one's own says in `decide` what comes next, and of the rest only what is different in it.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Generic, Literal, TypeVar

from pydantic import BaseModel, Field

from common import messages as m
from common.config import GripperConfig, Parameters, RobotConfig, Run, Tunable
from common.errors import ConfigError
from common.tasks.stages import Command, Execution, Grip, Look, Move, Stage, View
from common.tasks.watchdogs import FrameAge, Patience

V = TypeVar("V", bound=View)

MOST_FAILURES = 10
PAUSE, LONGEST_PAUSE = 0.25, 2.0  # [s] after the second failure in a row, doubled with each more, and at most
OVERTIME = 30.0  # [s] a motion that takes so much longer than planned is stopped
RETREAT = 0.1  # [m] upwards
MOVED = 0.005  # [m] what stands this far from where anything stood before is new there


class TaskConfig(Parameters):
    """What every task needs; times are cell time unless they say wall. A task adds parameters and sections."""

    robot: RobotConfig
    run: Run
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
        1.0, ge=0, le=3600, description="what is in the way of a motion for longer has it planned anew [s]"
    )


class Deciding(Generic[V]):
    """What a task says, what it decides, and what helps it to: `decide` is its own, all else has a default."""

    p: TaskConfig
    status: m.TaskStatus

    def __init_subclass__(cls, **given: object) -> None:
        """Refuse a method that would take the place of one that is not meant for it.

        Raises:
            TypeError: names it.
        """
        super().__init_subclass__(**given)
        for base in cls.__mro__[1:]:
            if base.__module__.startswith(f"{__package__}."):
                for name in vars(cls).keys() & vars(base).keys():
                    if name.startswith("_") and not name.startswith("__"):
                        raise TypeError(f"{cls.__name__}.{name}: {base.__name__} has a method of that name for itself; "
                                        "choose another")

    def __init__(self, config: TaskConfig, status: m.TaskStatus, prefix: str, speed: float = 1.0) -> None:
        """Start from nothing known.

        Args:
            config: read where it is used: it may change meanwhile.
            status: an empty one.
            prefix: begins every id that is minted here; unlike that of any other process.
            speed: cell time that passes per wall time.
        """
        self.p, self.status, self.prefix, self.speed = config, status, prefix, speed
        self.status.started = config.run.autostart
        self.row: deque[Stage] = deque()
        self.running: Execution | None = None
        self._opening: Execution | None = None  # what was let go is free of the fingers, which open on
        self._shut = False  # fingers that closed about nothing ahead of the arm have to be opened before what is next
        self._early: Execution | None = None  # of the fingers, which wait for the motion that runs to be nearly over
        self._held_up = False  # the arm was as fingers closed early: the next ones close once it stands
        self.patience = Patience()
        self.look_after = 0.0  # only a picture that is later decides [s]
        self._frames = FrameAge(speed)
        self._planning: tuple[Move, str] | None = None
        self._in_the_way = Patience()
        self._stopping = False
        self._found = False  # whether the robot was looked at, or a person has said what to do
        self._began: float | None = None
        self._minted = 0
        self._failures_in_a_row = self._done_before = 0
        self._again_at = -math.inf  # not before this is anything tried after failures [s]

    # --- what a task decides ---------------------------------------------------------------------------------

    def decide(self, view: V) -> None:
        """With nothing under way: append what comes next to `row`, or say in `status.state` that it is DONE."""
        raise NotImplementedError

    def decide_ahead(self, running: Stage, view: V) -> None:
        """While a stage runs: append what is to follow, so that it is planned meanwhile."""

    def note(self, view: V) -> None:
        """With each step: bring the counters of the status up to date."""

    def may_begin(self, stage: Stage, view: V) -> bool:
        """Whether a stage that is planned may begin now; if not, it waits, or `clear` has thrown the row away."""
        if not isinstance(stage, Move) or not stage.fresh:
            return True
        waits = f"{stage.name} waits"
        if unseen := self.unseen(view):
            self.status.message = f"{waits}: {unseen}"
            return False
        if self.status.message.startswith(waits):
            self.status.message = ""
        return True

    def outdated(self, stage: Stage, view: V) -> str:
        """Why what runs makes no sense any more: the arm is stopped then, and all decided anew. Empty while it does."""
        return ""

    def planned(self, move: Move, response: m.PlanResponse) -> None:
        """Take note of the answer to a plan request, good or bad."""

    def succeeded(self, stage: Stage, view: V) -> None:
        """Take note of what a stage has done."""

    def missed(self, stage: Grip, view: V) -> None:
        """The fingers closed on nothing, or on what is not as wide as expected: open, back off and look again."""
        self.status.retries += 1
        self.fail(f"{stage.name}: {stage.problem}", view, go_home=False)
        if self.status.state != "ERROR":
            self.row += [Grip("open", stage.state, width=self.gripper.max_width), *self.back_off(view.let_go())]

    def forgotten(self, stage: Stage, view: V) -> None:
        """A controller that was started again knows nothing of a stage that it had begun."""
        self.fail(f"{stage.name} was forgotten by the controller", view)

    def displaced(self, stage: Stage, view: V, problem: str) -> None:
        """The robot is not where the plan began: by hand, or by a controller that has forgotten how it got there."""
        self.fail(problem, view, go_home=False)  # all it needs is a new plan

    def obstructed(self, stage: Stage, view: V, problem: str) -> None:
        """Something came in the way of a motion and stays there: what is held is brought on around it."""
        self.fail(problem, view, go_home=not view.holding)

    def plan_failed(self, move: Move, response: m.PlanResponse, view: V) -> None:
        """There is no way: free the arm from what it stands against, or go home and decide anew."""
        if self.stands_against(move, response):
            self.fail(response.message, view, go_home=False)
            if self.status.state != "ERROR":
                self.row += self.back_off(view, response.colliding)
        else:
            # What runs is sound; what was to follow is decided anew when it has ended.
            self.fail(response.message, view, go_home=self.running is None and move.name != "home")

    def fail(self, message: str, view: V, *, go_home: bool = True) -> None:
        """Count a failure, throw the row away and, where it helps, go home to look again."""
        go_home = go_home and self._early is None  # what the fingers began ends first
        self.clear()
        self.look_after = view.now
        self.status.message = message
        self.status.failures += 1
        self._failures_in_a_row += 1
        if self._failures_in_a_row >= self.most_failures:
            self.status.state = "ERROR"
            self.status.message = f"{message}; that makes {self._failures_in_a_row} failures in a row"
        elif go_home:
            self.row += [self.home(view), Look()]
        if self._failures_in_a_row > 1:  # what is known may be older than the world: let it come
            self._again_at = view.now + min(PAUSE * 2 ** (self._failures_in_a_row - 2), LONGEST_PAUSE)

    def began_anew(self) -> None:
        """A person has started it once more after its end."""

    @property
    def memory(self) -> BaseModel | None:
        """What cannot be seen or felt again and is to outlive a restart: replaced by another when it changes."""
        return None

    def remember(self, memory: BaseModel) -> None:
        """Go on from the memory that the task had before it was started again."""
        raise NotImplementedError

    def home(self, view: V) -> Move:
        """To the pose from which everything is seen, with whatever is held."""
        return Move("home", "HOMING", goal=m.JointGoal(named="home"), carries=view.holding)

    def back_off(self, view: V, contact: tuple[str, str] | None = None) -> list[Stage]:
        """Away from where the hand is, whatever it touches there, to where everything is seen."""
        return [self.retreat(view, contact), self.home(view), Look()]

    def retreat(self, view: V, contact: tuple[str, str] | None = None, height: float = RETREAT) -> Move:
        """Straight up from where the tool is, whatever the hand touches there now."""
        assert view.tcp is not None
        at = view.tcp.position
        pose = view.tcp.model_copy(update={"position": m.Vector3(x=at.x, y=at.y, z=at.z + height)})
        touches = [(link, thing.id) for link in self.gripper.links for thing in view.objects("target")]
        return Move("retreat", "HOMING", goal=m.PoseGoal(pose=pose), straight=True, carries=view.holding,
                    touches=[*touches, *([contact] if contact else [])])

    def obstacles(self, move: Move, view: V) -> list[tuple[float, float]]:
        """(x, y) [m] of what stood in the way when a motion was planned; another one there has it planned anew."""
        subject = move.cycle.subject if move.cycle else ""
        return [(o.pose.position.x, o.pose.position.y) for o in view.objects("target") if o.id != subject]

    def request(self, move: Move, start: list[float], view: V) -> m.PlanRequest:
        """What is asked of the planner for a motion; an empty `start` is where the robot is."""
        return m.PlanRequest(
            id=self.mint(), stage=move.name, start=start, goal=move.goal, straight=move.straight,
            allowed_collisions=move.touches, attach=move.attach or view.attached if move.carries else "",
            attach_pose=move.attach_pose, release=not move.carries, planning_time=self.p.planning_time,
        )

    def time_limit(self, stage: Stage) -> float:
        """A stage that takes longer is stopped [s]."""
        return OVERTIME + (stage.seconds if isinstance(stage, Move) else 0.0)

    @property
    def most_failures(self) -> int:
        """So many in a row, and it gives up."""
        return MOST_FAILURES

    @property
    def moved(self) -> float:
        """What stands this far from where anything stood before is new there [m]."""
        return MOVED

    # --- what helps to decide --------------------------------------------------------------------------------

    @property
    def under_way(self) -> list[Stage]:
        """What arm and fingers do: of fingers that begin before the arm stands the status tells once it does."""
        return [one.stage for one in (self.running, self._early) if one is not None and one.begun]

    @property
    def waits_for_the_arm(self) -> str:
        """Name of the stage of fingers that were asked to begin before the arm stands; they may have, untold."""
        return self._early.stage.name if self._early is not None else ""

    @property
    def gripper(self) -> GripperConfig:
        """The robot's gripper.

        Raises:
            ConfigError: it has none.
        """
        if self.p.robot.gripper is None:
            raise ConfigError("robot.gripper", ..., "is missing: the task needs a robot with one")
        return self.p.robot.gripper

    def unseen(self, view: V) -> str:
        """Why the newest picture cannot be decided by; empty when it can."""
        return self._frames.problem(view.now, view.stamps, self.p.frame_timeout, self.p.clock_tolerance)

    def sees(self, view: V) -> bool:
        """Whether there is a picture to decide by, which is later than what was done since; else the status says so."""
        if unseen := self.unseen(view):
            self.status.message = unseen
        return not unseen and min(view.stamps) > self.look_after

    def stands_against(self, move: Move, response: m.PlanResponse) -> bool:
        """Whether a plan failed because the arm touches something where it stands, from which a retreat may free it."""
        collides = response.error == "start_in_collision" and response.colliding is not None
        return collides and self.running is None and move.name != "retreat"

    def end(self, state: Literal["DONE", "ERROR"], message: str = "") -> None:
        """That is the end, until a person starts it once more."""
        self.clear()
        self.status.state, self.status.stage, self.status.message = state, "", message

    def clear(self) -> None:
        """Throw the row away; what runs goes on."""
        self.row.clear()
        self._planning = None

    def stop(self, view: V, reason: str, by: Literal["operator", "requester"] = "requester") -> list[Command]:
        """Throw the row away and bring the arm to rest; fingers finish what they began."""
        self.clear()
        self.look_after = view.now
        if self.running is None or not self.running.moves_arm:
            return []
        running, self.running, self._stopping = self.running, None, True
        self.status.moving_seconds += running.moving
        return [m.StopRequest(id=running.command.id, reason=reason, by=by)]

    def mint(self) -> str:
        """An id that nobody else has."""
        self._minted += 1
        return f"{self.prefix}-{self._minted}"
