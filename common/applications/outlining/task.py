"""The outline task: a chosen contour goes in, requests for motion come out.

Everything from the approach to the way home is planned before the arm moves, because once it is over the objects the
camera sees the arm. What goes wrong ends in ERROR with one line, the arm at rest, at home where it can be brought.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator

from pydantic import Field

from common import messages as m
from common.applications.outlining.legs import Close, Leg, Legs, OutlineView, TracingParameters, closed, length
from common.applications.outlining.messages import OutlinePoints, OutlineStatus
from common.config import GripperConfig, Tunable
from common.tasks.execution import ANEW, FOUND_HELD, Execution, note_plan
from common.tasks.pictures import Pictures

Stage = Leg | Close
Command = m.PlanRequest | m.ExecuteRequest | m.GripperCommand | m.StopRequest | m.HoldRequest

AT_HOME = 0.01  # [rad] from it
MOST_FORGOTTEN = 5  # motions in a row, each by a controller that was started again
SHUT = 0.002  # [m] fingers this close together count as closed


class OutlineParameters(TracingParameters):
    """How the task behaves; times are cell time unless they say wall."""

    planning_time: Tunable[float] = Field(10.0, gt=0, le=600, description="wall time for one plan [s]")
    overtime: Tunable[float] = Field(
        30.0, gt=0, le=3600, description="a motion that takes so much longer is stopped [s]"
    )
    frame_timeout: Tunable[float] = Field(
        3.0, ge=0.1, le=60, description="a contour from an older picture starts no motion [s, wall time]"
    )
    clock_tolerance: Tunable[float] = Field(
        0.2, ge=0.01, le=10, description="a picture from so far in the future starts no motion: the clocks of camera "
                                         "and task differ [s, wall time]"
    )
    joint_states_timeout: Tunable[float] = Field(
        0.2, ge=0.05, le=60, description="without joint states for so long the arm is held on its path [s, wall time]"
    )
    selection_timeout: Tunable[float] = Field(
        10.0, ge=0, le=3600, description="wait for a usable contour while pictures come, before giving up; 0: for "
                                         "ever [s, wall time]"
    )
    picture_timeout: Tunable[float] = Field(
        60.0, ge=0, le=3600, description="wait for pictures while none comes, before giving up; longer than a camera "
                                         "or detector takes to be started again; 0: for ever [s, wall time]"
    )


class Outline:
    """State machine of the task. Feed it with `step` and the `on_...` methods; it has no clock and no network."""

    def __init__(
        self, parameters: OutlineParameters, gripper: GripperConfig, home: list[float], prefix: str,
        started: bool = True, speed: float = 1.0,
    ) -> None:
        """Start from nothing known.

        Args:
            parameters: heights, speed and times, read where they are used: they may change meanwhile.
            gripper: its links may touch what is traced.
            home: joint positions [rad] at which the camera sees everything.
            prefix: begins every id that is minted here; unlike that of any other process.
            started: whether to begin without being told.
            speed: cell time that passes per wall time.
        """
        self.p, self.legs = parameters, Legs(parameters, gripper)
        self.status = OutlineStatus(started=started, standoff=parameters.standoff)
        self._home, self._speed = home, speed
        self._pictures = Pictures(speed)
        self._ids = (f"{prefix}-{n}" for n in itertools.count(1))
        self._stages: deque[Stage] = deque()
        self._running: Execution[Stage] | None = None
        self._stopping = False
        self._planning: tuple[Leg, str] | None = None
        self._selecting: tuple[bool, float] | None = None  # whether no pictures come, and since when
        self._began: float | None = None
        self._traced = False
        self._found = False  # whether the robot was looked at, or a person has said what to do
        self._returned = False  # home was reached and not left since
        self._still_since = 0.0  # only a later picture shows everything without the arm in it
        self._error = ""  # what went wrong, while the arm is brought home
        self._forgotten = 0  # motions since the last that ended well
        self._excused: tuple[str, str] | None = None  # contact from which the arm has to be freed

    # --- what a person says ----------------------------------------------------------------------------------

    def command(self, command: str, view: OutlineView) -> list[Command]:
        """Start, pause, resume or stop: a pause holds the arm on its path, from which it goes on; a stop ends that.

        After a stop the arm goes home and outlines the object anew: half an outline is no outline.
        """
        status = self.status
        self._selecting, self._found = None, True
        if command == "pause":
            status.paused = True
            return [m.HoldRequest(hold=True, reason="the task is paused")]
        reason = f"the task was told to {command}"
        if command in ("start", "resume"):
            status.started, status.paused = status.started or command == "start", False
            if command == "start" and status.state in ("DONE", "ERROR"):
                status.state, status.message, status.closed = "IDLE", "", False
                self._began, self._traced = None, False
            return [m.HoldRequest(hold=False, reason=reason)]
        status.paused = status.started = False
        return self._stop(view, reason) or [m.StopRequest(reason=reason)]

    # --- answers ---------------------------------------------------------------------------------------------

    def on_plan(self, response: m.PlanResponse, view: OutlineView) -> None:
        """Take in the answer to a plan request."""
        if self._planning is None or self._planning[1] != response.id:
            return  # of stages that were thrown away meanwhile
        leg, _ = self._planning
        self._planning = None
        note_plan(self.status, response)
        if response.ok and response.trajectory is not None:
            leg.trajectory = response.trajectory
            if leg.name == "trace":
                self.status.fraction = response.fraction
        elif self._error and leg.name == "retreat" and response.colliding and self._excused is None:
            self._excused = response.colliding  # free the arm from what it stands against
            self._recover(view)
        elif self._error and leg.name == "retreat":
            self._stages = deque([self.legs.home()])
        elif self._error:
            self._end(f"{self._error}; the arm stays where it is: {response.message}")
        else:
            if leg.name == "trace":
                self.status.fraction = response.fraction
            self._fail(f"{self.status.subject}: {response.message}" if self.status.subject else response.message, view)

    def on_goal(self, answer: m.MotionStatus | m.GripperState, view: OutlineView) -> None:
        """Take in the answer to execute or to a gripper command: accepted, or refused with a reason."""
        if self._running is None or self._running.command.id != answer.id or self._running.accept(answer):
            return
        stage, self._running = self._running.stage, None
        # What somebody else asked for, or that it came too late, is no failure: it is decided anew.
        if isinstance(answer, m.MotionStatus) and answer.error in ANEW:
            self._clear()
            self._returned, self.status.message = False, f"{stage.name} has to wait: {answer.message}"
            return
        self._fail(f"{stage.name} was refused: {answer.message}", view)

    # --- the step --------------------------------------------------------------------------------------------

    def step(self, view: OutlineView) -> list[Command]:
        """What to ask for now, given what is known."""
        if view.missing:
            self.status.message = f"waiting for {', '.join(view.missing)}"
            return []
        assert view.motion is not None and view.gripper is not None
        if not self._found:
            self._found, self.status.paused = True, view.motion.paused
            if view.motion.paused:
                self.status.message = FOUND_HELD
        if self._began is None and self.status.started:
            self._began = view.now
        commands = self._watch(view)
        self._stopping = self._stopping and view.motion.state == "active"
        waiting = self.status.paused or view.motion.held or not self.status.started
        if commands or self._stopping or waiting or self.status.state in ("DONE", "ERROR"):
            return commands
        self.status.task_seconds = view.now - (self._began or view.now)
        if self._running is None and not self._stages and not (view.motion.state == "active" or view.gripper.moving):
            self._decide(view)
        return [*self._plan_ahead(), *(() if view.trouble else self._advance(view))]

    def _watch(self, view: OutlineView) -> list[Command]:
        """Follow the stage that runs to its end or its failure."""
        assert view.motion is not None and view.gripper is not None
        if self._running is None:
            self._returned = self._returned and view.motion.state != "active"  # somebody else moves it
            return []
        running, stage = self._running, self._running.stage
        running.count(view.now, view.motion)
        outcome = running.outcome(view.motion, view.gripper)
        longest = self.p.overtime + (stage.seconds if isinstance(stage, Leg) else 0.0)
        if outcome == "ended":
            self._running = None
            self.status.moving_seconds += running.moving
            reported = running.report(view.motion, view.gripper)
            if reported.state == "cancelled" and running.moves_arm:
                self._clear()
                self.status.paused = True
                self.status.message = f"{stage.name} was stopped from outside ({reported.message}); resume to go on"
            elif reported.state != "succeeded":
                self._fail(f"{stage.name} {reported.state}: {reported.message}", view)
            else:
                self._succeed(stage, view)
        elif outcome == "forgotten":
            self._running = None
            self._forget(stage, view)
        elif running.spent > longest:
            stop = self._stop(view, "it takes too long")
            self._fail(f"{stage.name} took longer than {longest:.0f} s", view)
            return stop
        return []

    def _succeed(self, stage: Stage, view: OutlineView) -> None:
        """Take note of what a stage has done."""
        self._forgotten = 0
        if stage.name == "trace":
            self._traced, self.status.closed = True, self.status.fraction >= 1
        elif stage.name == "home":
            self._returned, self._still_since = True, view.now

    def _forget(self, stage: Stage, view: OutlineView) -> None:
        """Decide anew, from home: the controller was started again, and what it was asked for was no mistake."""
        self._forgotten += 1
        problem = f"{stage.name} was forgotten by the controller"
        if self._forgotten > MOST_FORGOTTEN:
            self._fail(problem, view)
            return
        self._clear()
        self.status.failures += 1
        self._returned, self._selecting, self.status.message = False, None, problem

    # --- what to do next -------------------------------------------------------------------------------------

    def _decide(self, view: OutlineView) -> None:
        """With nothing under way: go home first, end, or look for a contour and plan around it."""
        if not self._is_home(view):
            self._recover(view)
        elif self._error:
            self._end(self._error)
        elif self._traced:
            self.status.state, self.status.stage, self.status.message = "DONE", "", ""
        else:
            self._select(view)

    def _select(self, view: OutlineView) -> None:
        """Take the chosen contour once the planning scene holds its object; give up after a while without one."""
        self.status.state, self.status.stage = "SELECTING", ""
        path = view.path
        if path is not None and path.header.stamp * 1e-9 < self._still_since:
            path = None
        solid = view.solid()
        unseen = "no contour came from the camera" if path is None else self._unseen(path, view)
        if path is not None and len(path.poses) > 1 and solid is not None and not unseen:
            self._take(path, solid, view)
            return
        if path is None or unseen:
            problem = unseen
        elif not path.poses:
            problem = path.message or "no object is chosen"
        elif len(path.poses) < 2:  # noqa: PLR2004 - a point has no outline
            problem = f"the contour of {path.object} is a single point"
        else:
            problem = f"the planning scene does not hold {path.object or 'the object'} around which the contour goes"
        self.status.message = problem
        if self._selecting is None or self._selecting[0] != bool(unseen):
            self._selecting = bool(unseen), view.now
        # Waiting for a person or for pictures is by the clock on the wall, also in a fast cell.
        limit = self.p.picture_timeout if unseen else self.p.selection_timeout
        if 0 < limit * self._speed < view.now - self._selecting[1]:
            self._fail(problem, view)

    def _take(self, path: OutlinePoints, solid: str, view: OutlineView) -> None:
        """Make the motions for a contour that goes round a solid of the planning scene."""
        assert view.gripper is not None
        points = closed(path)
        status = self.status
        status.state, status.message, status.subject = "PLANNING", "", path.object
        status.points, status.length_m, status.fraction, status.closed = len(path.poses), length(points), 0.0, False
        status.invalid_depth, status.standoff = path.invalid_depth, self.p.standoff
        if view.gripper.width > SHUT:
            self._stages.append(Close())
        self._stages += self.legs.outline(points, solid)

    def _unseen(self, path: OutlinePoints, view: OutlineView) -> str:
        """Why the picture in which a contour was found can not be decided by; empty when it can."""
        stamps = (path.header.stamp * 1e-9,)
        return self._pictures.problem(view.now, stamps, self.p.frame_timeout, self.p.clock_tolerance)

    def _is_home(self, view: OutlineView) -> bool:
        assert view.q is not None
        return self._returned or max(abs(a - b) for a, b in zip(view.q, self._home, strict=True)) < AT_HOME

    def _plan_ahead(self) -> Iterator[Command]:
        """Ask for the first motion that has no trajectory, from where the one before it ends."""
        if self._planning is not None:
            return
        running = self._running.stage if self._running else None
        end = running.end() if isinstance(running, Leg) else []
        for leg in self._stages:
            if not isinstance(leg, Leg):
                continue
            if leg.trajectory is None:
                request = m.PlanRequest(
                    id=next(self._ids), stage=leg.name, start=end, goal=leg.goal, straight=leg.straight,
                    allowed_collisions=leg.touches, planning_time=self.p.planning_time,
                )
                self._planning = (leg, request.id)
                yield request
                return
            end = leg.end()

    def _advance(self, view: OutlineView) -> Iterator[Command]:
        """Begin the next stage when the one before it has ended; the first motion once all are planned."""
        if self._running is not None or not self._stages:
            return
        stage = self._stages[0]
        command: m.ExecuteRequest | m.GripperCommand
        if isinstance(stage, Close):
            command = m.GripperCommand(id=next(self._ids), width=0.0)
        elif all(leg.trajectory is not None for leg in self._stages if isinstance(leg, Leg)):
            assert stage.trajectory is not None
            if stage.name == "approach" and (view.path is None or self._unseen(view.path, view)):
                self._clear()  # look again: what was planned around may have moved
                self._selecting = None
                return
            command = m.ExecuteRequest(id=next(self._ids), trajectory=stage.trajectory)
            self.status.state, self._returned = stage.state, False
        else:
            return
        self._stages.popleft()
        self._running = Execution(stage, command, view.now)
        self.status.stage = stage.name
        yield command

    # --- failure ---------------------------------------------------------------------------------------------

    def _fail(self, message: str, view: OutlineView) -> None:
        """End in ERROR, by way of home when the arm is somewhere else."""
        self._clear()
        self.status.failures += 1
        first, self._error = self._error, self._error or message
        self.status.message = self._error
        self._selecting = None
        if self._running is not None:  # the fingers are still closing: they may finish
            return
        if first:
            self._end(f"{first}; the arm stays where it is: {message}")
        elif self._is_home(view):
            self._end(message)
        else:
            self._recover(view)

    def _recover(self, view: OutlineView) -> None:
        """Up and home, from wherever the arm is."""
        assert view.scene is not None
        self._clear()
        self._stages += [*([self.legs.retreat(view.tcp, view.scene, self._excused)] if view.tcp else []),
                         self.legs.home()]

    def _end(self, message: str) -> None:
        self._clear()
        self._error, self._excused = "", None
        self.status.state, self.status.stage, self.status.message = "ERROR", "", message

    def _clear(self) -> None:
        self._stages.clear()
        self._planning = None

    def _stop(self, view: OutlineView, reason: str) -> list[Command]:
        """Forget what was planned and bring the arm to rest; fingers finish what they began."""
        self._clear()
        if self._running is None or not self._running.moves_arm:
            return []
        running, self._running, self._stopping = self._running, None, True
        self.status.moving_seconds += running.moving
        return [m.StopRequest(id=running.command.id, reason=reason)]
