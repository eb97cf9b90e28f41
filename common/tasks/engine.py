"""The task engine: what is known goes in, requests for motion come out. A task of one's own only decides.

One row of stages is worked off from the left. Motions further right are planned while the one on the left runs, each
from where the one before it ends. When reality differs from the plan (the fingers closed on nothing, what was held
fell, the scene changed, a controller refused) the rest of the row is thrown away and decided anew from what is seen
and held, which is also how a task carries on after it was started again in the middle of a run.

The engine has no clock and no network: it is fed with `step`, `command` and the `on_...` methods.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Generic, Literal, TypeVar

from pydantic import Field

from common import messages as m
from common.config import GripperConfig, Parameters, RobotConfig, Run, Tunable
from common.errors import ConfigError
from common.tasks.stages import Command, Execution, Grip, Look, Move, Report, Stage, View
from common.tasks.watchdogs import FrameAge, Patience

V = TypeVar("V", bound=View)

ANEW = ("busy", "stale_request", "clock_ahead")  # refusals of a motion that have nothing to do with the motion
FOUND_HELD = "the robot was found held; resume or start to go on"
MOST_FIGURES = 200  # plans that a status tells of: a cell may run for days
MOST_FAILURES = 10
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


class Task(Generic[V]):
    """State machine of a task. Override `decide`, and of the rest what is different in yours.

    What it may use: `row`, to which `decide` appends stages; `running`, what is under way; `status`; `patience`, for
    what it waits for; and the methods below.
    """

    p: TaskConfig
    status: m.TaskStatus

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
        self.patience = Patience()
        self.look_after = 0.0  # only a picture that is later decides [s]
        self._frames = FrameAge(speed)
        self._planning: tuple[Move, str] | None = None
        self._stopping = False
        self._found = False  # whether the robot was looked at, or a person has said what to do
        self._began: float | None = None
        self._minted = 0
        self._failures_in_a_row = self._done_before = 0

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

    def planned(self, move: Move, response: m.PlanResponse) -> None:
        """Take note of the answer to a plan request, good or bad."""

    def succeeded(self, stage: Stage, view: V) -> None:
        """Take note of what a stage has done."""

    def missed(self, stage: Grip, view: V) -> None:
        """The fingers closed on nothing: open them, back off and look again."""
        self.status.retries += 1
        self.fail(f"{stage.name}: the fingers closed on nothing", view, go_home=False)
        if self.status.state != "ERROR":
            self.row += [Grip("open", stage.state, width=self.gripper.max_width), *self.back_off(view)]

    def forgotten(self, stage: Stage, view: V) -> None:
        """A controller that was started again knows nothing of a stage that it had begun."""
        self.fail(f"{stage.name} was forgotten by the controller", view)

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

    def began_anew(self) -> None:
        """A person has started it once more after its end."""

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

    def stop(self, view: V, reason: str) -> list[Command]:
        """Throw the row away and bring the arm to rest; fingers finish what they began."""
        self.clear()
        self.look_after = view.now
        if self.running is None or not self.running.moves_arm:
            return []
        running, self.running, self._stopping = self.running, None, True
        self.status.moving_seconds += running.moving
        return [m.StopRequest(id=running.command.id, reason=reason)]

    def mint(self) -> str:
        """An id that nobody else has."""
        self._minted += 1
        return f"{self.prefix}-{self._minted}"

    # --- what a person says ----------------------------------------------------------------------------------

    def command(self, command: str, view: V) -> list[Command]:
        """Start, pause, resume or stop: a pause holds the arm on its path, from which it goes on; a stop ends that."""
        status = self.status
        self.patience.reset()
        self._found = True
        if command == "pause":
            status.paused = True
            return [m.HoldRequest(hold=True, reason="the task is paused")]
        reason = f"the task was told to {command}"
        if command in ("start", "resume"):
            status.started, status.paused = status.started or command == "start", False
            if command == "start" and status.state in ("DONE", "ERROR"):
                status.state, status.message = "IDLE", ""
                self._began, self._failures_in_a_row = None, 0
                self.began_anew()
            return [m.HoldRequest(hold=False, reason=reason)]
        status.paused = status.started = False
        return self.stop(view, reason) or [m.StopRequest(reason=reason)]

    # --- answers ---------------------------------------------------------------------------------------------

    def on_plan(self, response: m.PlanResponse, view: V) -> None:
        """Take in the answer to a plan request."""
        if self._planning is None or self._planning[1] != response.id:
            return  # of a row that was thrown away meanwhile
        move, _ = self._planning
        self._planning = None
        self._note_plan(response)
        self.planned(move, response)
        if response.ok and response.trajectory is not None:
            move.trajectory = response.trajectory
        else:
            self.plan_failed(move, response, view)

    def _note_plan(self, response: m.PlanResponse) -> None:
        """Count it in the figures: its time always, its planner when it brought a trajectory."""
        self.status.planning_seconds += response.seconds
        if response.ok and response.trajectory is not None:
            self.status.plans.append(m.PlanFigure(
                planner=response.planner, seconds=response.seconds, fraction=response.fraction,
                attempts=max(1, len(response.attempts)),
            ))
            del self.status.plans[:-MOST_FIGURES]

    def on_goal(self, answer: Report, view: V) -> None:
        """Take in the answer to execute or to a gripper command: accepted, or refused with a reason."""
        if self.running is None or self.running.command.id != answer.id or self.running.accept(answer):
            return
        stage, self.running = self.running.stage, None
        # What somebody else asked for, or that it came too late, is no failure: it is decided anew.
        if isinstance(answer, m.MotionStatus) and answer.error in ANEW:
            self.clear()
            self.look_after = view.now
            self.status.message = f"{stage.name} has to wait: {answer.message}"
            return
        # A robot that is not where the plan began only needs a new plan.
        stale = isinstance(answer, m.MotionStatus) and answer.error == "start_mismatch"
        self.fail(f"{stage.name} was refused: {answer.message}", view, go_home=not stale)

    # --- the step --------------------------------------------------------------------------------------------

    def step(self, view: V) -> list[Command]:
        """What to ask for now, given what is known."""
        status = self.status
        if view.missing:
            status.message = f"waiting for {', '.join(view.missing)}"
            return []
        assert view.motion is not None and view.gripper is not None
        if not self._found:
            self._found, status.paused = True, view.motion.paused
            if view.motion.paused:
                status.message = FOUND_HELD
        if self._began is None and status.started:
            self._began = view.now
        commands = self._watch(view)
        self._stopping = self._stopping and view.motion.state == "active"
        waits = status.paused or view.motion.held or not status.started or status.state == "ERROR"
        if waits or commands or self._stopping:
            self._count(view)
            return commands
        while self.running is None and self.row and isinstance(self.row[0], Look):
            self.row.popleft()
            self.look_after = view.now
        if self.running is not None:
            self.decide_ahead(self.running.stage, view)
        elif not self.row and not (view.motion.state == "active" or view.gripper.moving):
            self.decide(view)  # not before what a task before this one began has ended
        if status.state not in ("DONE", "ERROR"):
            status.task_seconds = view.now - (self._began or view.now)
        self._count(view)
        return [*self._plan_ahead(view), *(() if view.trouble else self._advance(view))]

    def _count(self, view: V) -> None:
        self.note(view)
        if self.status.done > self._done_before:
            self._failures_in_a_row = 0
        self._done_before = self.status.done

    def _watch(self, view: V) -> list[Command]:
        """Follow the stage that runs: its end, its failure, and what falls out of the hand."""
        if self.running is None:
            return []
        assert view.motion is not None and view.gripper is not None
        running, stage = self.running, self.running.stage
        running.count(view.now, view.motion)
        outcome = running.outcome(view.motion, view.gripper)
        limit = self.time_limit(stage)
        if outcome == "ended":
            self.running = None
            self.status.moving_seconds += running.moving
            self._ended(stage, running.report(view.motion, view.gripper), view)
        elif outcome == "forgotten":
            self.running = None
            self.forgotten(stage, view)
        elif running.moves_arm and stage.carries and not view.holding:
            stop = self.stop(view, "what it held fell")
            self.fail(f"what the hand held fell during {stage.name}", view, go_home=False)
            return stop
        elif running.spent > limit:
            stop = self.stop(view, "it takes too long")
            self.fail(f"{stage.name} took longer than {round(limit, 2):g} s", view)
            return stop
        return []

    def _ended(self, stage: Stage, reported: Report, view: V) -> None:
        holds = stage.holds if isinstance(stage, Grip) else None
        if reported.state == "cancelled" and isinstance(stage, Move):
            self.clear()
            self.status.paused = True
            self.status.message = f"{stage.name} was stopped from outside ({reported.message}); resume to go on"
        elif reported.state != "succeeded":
            self.fail(f"{stage.name} {reported.state}: {reported.message}", view)
        elif isinstance(stage, Grip) and holds and not view.holding:
            self.missed(stage, view)
        elif holds is False and view.holding:
            self.fail("the fingers opened and still hold something", view)
        else:
            self.succeeded(stage, view)

    # --- planning and doing ----------------------------------------------------------------------------------

    def _plan_ahead(self, view: V) -> Iterator[Command]:
        """Ask for the first motion that has no trajectory, from where the one before it ends."""
        if self._planning is not None:
            return
        running = self.running.stage if self.running else None
        end = running.end() if isinstance(running, Move) else []
        for move in self.row:
            if not isinstance(move, Move):
                continue
            if move.trajectory is None:
                move.planned_around = self.obstacles(move, view)
                request = self.request(move, end, view)
                self._planning = (move, request.id)
                yield request
                return
            end = move.end()

    def _advance(self, view: V) -> Iterator[Command]:
        """Begin the next stage when the one before it has ended and its motion is planned and still right."""
        if self.running is not None or not self.row:
            return
        stage = self.row[0]
        if stage.carries and not view.holding:
            self.fail(f"what the hand held fell before {stage.name}", view, go_home=False)
            return
        if (isinstance(stage, Move) and not self._is_planned(stage)) or not self.may_begin(stage, view):
            return
        if isinstance(stage, Move) and appeared(self.obstacles(stage, view), stage.planned_around, self.moved):
            for later in self.row:
                if isinstance(later, Move):
                    later.trajectory = None
            self._planning = None
            yield from self._plan_ahead(view)
            return
        yield self._begin(stage, view)

    def _begin(self, stage: Stage, view: V) -> Command:
        self.row.popleft()
        command: m.ExecuteRequest | m.GripperCommand
        if isinstance(stage, Move):
            assert stage.trajectory is not None
            command = m.ExecuteRequest(id=self.mint(), trajectory=stage.trajectory)
        else:
            assert isinstance(stage, Grip)
            command = m.GripperCommand(id=self.mint(), width=stage.width)
        if stage.cycle is not None:
            stage.cycle.begun = True
        self.running = Execution(stage, command, view.now)
        self.status.state, self.status.stage = stage.state, stage.name
        self.status.subject = stage.cycle.subject if stage.cycle else ""
        return command

    def _is_planned(self, move: Move) -> bool:
        whole = [s for s in self.row if isinstance(s, Move) and s.cycle is move.cycle] if move.whole else [move]
        return all(stage.trajectory is not None for stage in whole)


def appeared(now: list[tuple[float, float]], before: list[tuple[float, float]], moved: float) -> bool:
    """Whether something stands now where nothing stood before; what went away is in nobody's way."""
    return any(all(math.dist(p, q) > moved for q in before) for p in now)
