"""The task engine: what is known goes in, requests for motion come out. A task of one's own only decides.

One row of stages is worked off from the left. Motions further right are planned while the one on the left runs, each
from where the one before it ends. When reality differs from the plan (the fingers closed on nothing, what was held
fell, the scene changed, a controller refused) the rest of the row is thrown away and decided anew from what is seen
and held, which is also how a task carries on after it was started again in the middle of a run.

The engine has no clock and no network: it is fed with `step`, `command` and the `on_...` methods.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from common import messages as m
from common.tasks.decisions import Deciding, V
from common.tasks.stages import MISSES, Command, Execution, Grip, Look, Move, Report, Stage

# Refusals that have nothing to do with the motion.
ANEW = ("busy", "stale_request", "clock_ahead", "stopped", "not_owner")
START = ": start to go on"
BLOCKED_BY = "scene_monitor"  # holds the arm while something is in the way
NO_ARM = "the arm cannot be moved: "
FOUND_HELD = "the robot was found held; resume or start to go on"
FINGERS_OFF = 0.003  # [m] by which fingers may stand elsewhere than a motion was planned with
LOOSE = 0.5e-3  # [m] by which fingers must have opened before they hold nothing any more
AHEAD = 1.0  # [s] before the end of a motion fingers are asked to wait for it: until then the row may change
CLOSE_WITHIN = 0.05  # [m] of it they may begin to close: they touch nothing before it
OPENED_BY = 0.5  # of a motion that began while the fingers opened: then they have
MOST_FIGURES = 200  # plans that a status tells of: a cell may run for days


class Task(Deciding[V]):
    """State machine of a task. Override `decide`, and of the rest what is different in yours.

    What it may use: `row`, to which `decide` appends stages; `running`, what is under way; `status`; `patience`, for
    what it waits for; and all of `Deciding`.
    """

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
                self._again_at = -math.inf
                self.began_anew()
            return [m.HoldRequest(hold=False, reason=reason, stops=command == "start")]
        status.paused = status.started = False
        return self.stop(view, reason, "operator") or [m.StopRequest(reason=reason)]

    # --- answers ---------------------------------------------------------------------------------------------

    def on_plan(self, response: m.PlanResponse, view: V) -> None:
        """Take in the answer to a plan request."""
        if self._planning is None or self._planning[1] != response.id:
            return  # of a row that was thrown away meanwhile
        move, _ = self._planning
        self._planning = None
        self._note_plan(response)
        self.planned(move, response)
        if response.ok and response.trajectory is not None and response.trajectory.points:
            move.trajectory, move.plan, move.scene_stamp = response.trajectory, response.id, response.scene_stamp
        elif move.otherwise and move in self.row and not response.error.startswith("start_"):
            at = self.row.index(move)
            self.row.remove(move)
            for stage in reversed(move.otherwise):
                self.row.insert(at, stage)
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
        begun = next((one for one in (self.running, self._early) if one and one.command.id == answer.id), None)
        if begun is None or begun.accept(answer):
            return
        stage = begun.stage
        if begun is self._early:  # then not before the arm is there
            assert isinstance(stage, Grip)
            self._early, stage.early = None, False
            if self.running is not None:
                self.row.appendleft(stage)
            return
        self.running = None
        # What somebody else asked for, or that it came too late, is no failure: it is decided anew.
        if answer.error in ANEW:
            self._decide_anew(f"{stage.name} has to wait: {answer.message}", view)
            return
        problem = f"{stage.name} was refused: {answer.message}"
        if isinstance(answer, m.MotionStatus) and answer.error == "start_mismatch":
            self.displaced(stage, view, problem)
        else:
            self.fail(problem, view)

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
                status.message = FOUND_HELD + "".join(f"; {one.description}" for one in view.motion.interlocks)
            if view.motion.stopped:  # by a person, whom no restart makes a liar of
                status.started = status.paused = False
        self._tell_stopped(view.motion.stopped)
        if self._began is None and status.started:
            self._began = view.now
        if self._early is not None and view.gripper.id == self._early.command.id:
            self._early.begun = self._early.begun or view.gripper.state != "cancelled"
        commands = self._watch(view)
        self._stopping = self._stopping and view.motion.state == "active"
        if view.motion.fault and not commands and self.running is None:
            status.message = f"{NO_ARM}{view.motion.fault}"
        elif status.message.startswith(NO_ARM):
            status.message = ""
        waits = status.paused or view.motion.held or view.motion.fault or not status.started or status.state == "ERROR"
        if waits or view.motion.stopped or commands or self._stopping or view.now < self._again_at:
            self._count(view)
            return commands
        while self.running is None and self.row and isinstance(self.row[0], Look):
            self.row.popleft()
            self.look_after = view.now
        if self.running is not None:
            self.decide_ahead(self.running.stage, view)
        elif not (self.row or self._early or view.motion.state == "active" or view.gripper.moving):
            shut, self._shut = self._shut, False  # not before what a task before this one began has ended
            if shut and not view.holding:
                self.row.append(Grip("open", status.state, width=self.gripper.max_width))
            else:
                self.decide(view)
        if status.state not in ("DONE", "ERROR"):
            status.task_seconds = view.now - (self._began or view.now)
        self._count(view)
        return [*self._plan_ahead(view), *(() if view.trouble else self._advance(view))]

    def _count(self, view: V) -> None:
        self.note(view)
        if self.status.done > self._done_before:
            self._failures_in_a_row = 0
        self._done_before = self.status.done

    def _tell_stopped(self, stopped: str) -> None:
        if stopped and self.status.state not in ("DONE", "ERROR"):
            self.status.message = stopped + START
        elif self.status.message.endswith(START):
            self.status.message = ""

    def _watch(self, view: V) -> list[Command]:
        """Follow the stage that runs: its end, its failure, and what falls out of the hand."""
        if self.running is None:
            self._watch_early(view)
            return self._watch_opening(view)
        assert view.motion is not None and view.gripper is not None
        running, stage = self.running, self.running.stage
        running.count(view.now, view.motion)
        if self._early is not None:  # what they wait is no time of theirs
            self._early.counted = view.now
        outcome = running.outcome(view.motion, view.gripper)
        limit = self.time_limit(stage)
        if running.let_go(view.gripper):  # the arm may leave while they open on
            self.running, self._opening = None, running
            self.status.moving_seconds += running.moving
            self.succeeded(stage, view)
        elif outcome == "ended":
            self.running = None
            self.status.moving_seconds += running.moving
            self._ended(stage, running.report(view.motion, view.gripper), view)
        elif outcome == "forgotten":
            self.running = None
            if self._early is not None and isinstance(self._early.stage, Grip):  # where it is let go nobody knows
                self._early = replace(self._early, stage=replace(self._early.stage, holds=None))
            self.forgotten(stage, view)
        elif running.moves_arm and stage.carries and not view.holding and not (self._early and self._early.begun):
            stop = self.stop(view, "what it held fell")
            slipped = f": {view.gripper.message}" if view.gripper.outcome == "slipping" else ""
            self.fail(f"what the hand held fell during {stage.name}{slipped}", view, go_home=False)
            return stop
        elif running.spent > limit:
            stop = self.stop(view, "it takes too long")
            self.fail(f"{stage.name} took longer than {round(limit, 2):g} s", view)
            return stop
        elif running.moves_arm and (why := self.outdated(stage, view)):
            stop = self.stop(view, why)
            self.status.message = f"{stage.name}: {why}"
            return stop
        elif blocked := self._blocked(view):
            stop = self.stop(view, blocked)
            self.obstructed(stage, view, f"{stage.name}: {blocked}")
            return stop
        elif stage.carries and view.gripper.outcome == "slipping":  # it may still arrive
            self.status.message = f"{stage.name}: {view.gripper.message}"
        return self._watch_opening(view)

    def _watch_early(self, view: V) -> None:
        """Follow fingers whose arm did not arrive: what they let go is, and what they hold is decided about anew."""
        if (early := self._early) is None:
            return
        assert view.motion is not None and view.gripper is not None
        early.count(view.now, view.motion)
        if view.motion.state == "active":  # it comes to rest
            return
        if view.motion.id == getattr(early.command, "after", ""):
            early.wait_no_more(view.motion, view.gripper)
        outcome = early.outcome(view.motion, view.gripper)
        if outcome == "running" and early.spent <= self.time_limit(early.stage):
            return
        self._early, self.look_after = None, view.now
        stage, reported = early.stage, early.report(view.motion, view.gripper)
        if outcome != "ended" or not isinstance(stage, Grip):
            return
        if stage.holds is False and reported.state == "succeeded" and not view.holding:
            self.succeeded(stage, view)
        elif stage.holds and isinstance(reported, m.GripperState) and reported.outcome in MISSES:
            self._shut = True
        elif reported.error == "hardware_fault":
            self.fail(f"{stage.name} {reported.state}: {reported.message}", view)

    def _watch_opening(self, view: V) -> list[Command]:
        """Follow fingers that open while the arm leaves already; one that they would not let through is stopped."""
        opening, running = self._opening, self.running
        if opening is None:
            return []
        assert view.motion is not None and view.gripper is not None
        state = view.gripper.state if view.gripper.id == opening.command.id else "cancelled"
        if state == "active":
            ours = running is not None and running.moves_arm and view.motion.id == running.command.id
            if not ours or view.motion.progress < OPENED_BY:
                return []
            why = "the fingers have not opened yet"
        else:
            self._opening, why = None, f"the fingers did not open: {view.gripper.message}"
        if state in ("succeeded", "cancelled"):  # by whom the fingers were told something else, that one answers for it
            return []
        stop = self.stop(view, why)
        self._opening = None
        if state == "active" and self.running is None:  # as a stage of its own, which takes as long as one may
            assert isinstance(opening.stage, Grip)
            self.running = replace(opening, stage=Grip("open", opening.stage.state, width=opening.stage.width))
            self.status.message = why
        else:
            self.fail(why, view)
        return stop

    def _blocked(self, view: V) -> str:
        """What stays in the way of the motion that runs; empty while nothing does, or it may still go away."""
        assert view.motion is not None and self.running is not None
        ours = view.motion.id == self.running.command.id and view.motion.state == "active"
        held = [one.reason for one in view.motion.interlocks if one.by == BLOCKED_BY and one.kind == "held"]
        if not held or not ours or view.trouble or view.motion.paused or self.status.paused:
            self._in_the_way.reset()
            return ""
        return held[0] if self._in_the_way.lasts("in the way", view.now) >= self.p.obstacle_patience else ""

    def _decide_anew(self, message: str, view: V) -> None:
        self.clear()
        self.look_after = view.now
        self.status.message = message

    def _ended(self, stage: Stage, reported: Report, view: V) -> None:
        holds = stage.holds if isinstance(stage, Grip) else None
        if reported.state == "cancelled" and isinstance(stage, Move):
            self.clear()
            if view.motion is not None and view.motion.stopped:  # by a person who did not reach us
                self.status.started = False
                return
            self.status.paused = True
            self.status.message = f"{stage.name} was stopped from outside ({reported.message}); resume to go on"
        elif reported.state == "cancelled":  # somebody else told the fingers something: no failure either
            self._decide_anew(f"{stage.name} was cancelled: {reported.message}", view)
        elif isinstance(stage, Grip) and holds and isinstance(reported, m.GripperState) and reported.outcome in MISSES:
            stage.problem = reported.message
            self.missed(stage, view)
        elif reported.error in ("hardware_fault", m.CLOSED_BEFORE) and isinstance(stage, Move):  # it is not to blame
            self._held_up = reported.error == m.CLOSED_BEFORE
            self._decide_anew(f"{stage.name} {reported.state}: {reported.message}", view)
        elif reported.state != "succeeded":
            self.fail(f"{stage.name} {reported.state}: {reported.message}", view)
        elif isinstance(stage, Grip) and holds and not view.holding:
            self.missed(stage, view)
        elif holds is False and view.holding:
            self.fail("the fingers opened and still hold something", view)
        else:
            self._held_up = self._held_up and not holds
            self.succeeded(stage, view)
            if self._early is not None and view.motion is not None and view.gripper is not None:
                self.running, self._early = self._early, None
                self.running.wait_no_more(view.motion, view.gripper)
                self.running.begun = True
                self._tell_stage(self.running.stage)

    # --- planning and doing ----------------------------------------------------------------------------------

    def _plan_ahead(self, view: V) -> Iterator[Command]:
        """Ask for the first motion that has no trajectory, from where the one before it ends."""
        if self._planning is not None:
            return
        running = self.running.stage if self.running else None
        end = running.end() if isinstance(running, Move) else []
        width = self._width(view)
        for grip in (running, self._early.stage if self._early else None):
            if width is not None and isinstance(grip, Grip):
                width = grip.width_after(width)
        for move in self.row:
            if width is not None and isinstance(move, Grip):
                width = move.width_after(width)
            if not isinstance(move, Move):
                continue
            if move.trajectory is None:
                move.planned_around, move.planned_width = self.obstacles(move, view), width
                request = self.request(move, end, view)
                if request.gripper_width is None:
                    request.gripper_width = width
                self._planning = (move, request.id)
                yield request
                return
            end = move.end()

    def _advance(self, view: V) -> Iterator[Command]:
        """Begin the next stage when the one before it has ended and its motion is planned and still right."""
        if self.running is not None:
            yield from self._begin_early(self.running, view)
        if self.running is not None or self._early is not None or not self.row:
            return
        stage = self.row[0]
        if stage.carries and not view.holding:
            self.fail(f"what the hand held fell before {stage.name}", view, go_home=False)
            return
        if (isinstance(stage, Move) and not self._is_planned(stage)) or not self.may_begin(stage, view):
            return
        if isinstance(stage, Move) and (
            appeared(self.obstacles(stage, view), stage.planned_around, self.moved) or self._fingers_differ(stage, view)
        ):
            for later in self.row:
                if isinstance(later, Move):
                    later.trajectory = None
            self._planning = None
            yield from self._plan_ahead(view)
            return
        yield self._begin(stage, view)

    def _begin_early(self, running: Execution, view: V) -> Iterator[Command]:
        """Have the fingers begin before the arm stands: until then they touch nothing, or let nothing go."""
        stage, arm = (self.row[0] if self.row else None), running.stage
        if not (isinstance(stage, Grip) and stage.early and isinstance(arm, Move)) or self._opening or self._early:
            return
        if stage.holds and self._held_up:
            return
        assert view.motion is not None and view.gripper is not None
        motion = view.motion
        if motion.id != running.command.id or motion.state != "active":
            return
        left = (1.0 - motion.progress) * arm.seconds
        if left <= AHEAD * motion.speed_scaling and stage.carries == view.holding and self.may_begin(stage, view):
            self.row.popleft()
            self._early = self._execution(stage, view)
            self._early.begun = False
            command = self._early.command
            assert isinstance(command, m.GripperCommand)
            command.after = running.command.id
            if stage.holds:
                way = 0.0 if stage.expected_width is None else view.gripper.width - stage.expected_width
                command.lead, command.within = min(self.gripper.least_time(way), AHEAD), CLOSE_WITHIN
            else:
                command.lead = min(self.gripper.least_time(LOOSE), AHEAD)
            yield command

    def _width(self, view: V) -> float | None:
        """Between the fingers now, or soon where they are opening [m]; None without any."""
        gripper = self.p.robot.gripper
        if gripper is None or not gripper.joints or view.gripper is None:
            return None
        width = view.gripper.width
        if self._opening is not None and isinstance(self._opening.stage, Grip):
            width = max(width, self._opening.stage.width)
        return min(max(width, 0.0), gripper.max_width)

    def _fingers_differ(self, move: Move, view: V) -> bool:
        """Whether the fingers stand elsewhere than planned; about what they hold they may be closer."""
        width, planned = self._width(view), move.planned_width
        if width is None or planned is None:
            return False
        return width > planned + FINGERS_OFF or (width < planned - FINGERS_OFF and not move.carries)

    def _begin(self, stage: Stage, view: V) -> Command:
        self.row.popleft()
        self.running = self._execution(stage, view)
        self._tell_stage(stage)
        return self.running.command

    def _tell_stage(self, stage: Stage) -> None:
        self.status.state, self.status.stage = stage.state, stage.name
        self.status.subject = stage.cycle.subject if stage.cycle else ""

    def _execution(self, stage: Stage, view: V) -> Execution:
        command: m.ExecuteRequest | m.GripperCommand
        if isinstance(stage, Move):
            assert stage.trajectory is not None
            command = m.ExecuteRequest(
                id=self.mint(), trajectory=stage.trajectory, plan=stage.plan, scene_stamp=stage.scene_stamp)
        else:
            assert isinstance(stage, Grip)
            command = m.GripperCommand(id=self.mint(), width=stage.width, effort=stage.effort, mass=stage.mass)
            if stage.expected_width is not None:
                command.expected_width, command.width_tolerance = stage.expected_width, stage.width_tolerance
        if stage.cycle is not None:
            stage.cycle.begun = True
        begun = Execution(stage, command, view.now)
        assert view.motion is not None and view.gripper is not None
        if isinstance(stage, Grip):
            self._opening = None  # it replaces that
            begun.held = view.gripper.width if view.holding else None
        begun.before = begun.report(view.motion, view.gripper).id
        return begun

    def _is_planned(self, move: Move) -> bool:
        whole = [s for s in self.row if isinstance(s, Move) and s.cycle is move.cycle] if move.whole else [move]
        return all(stage.trajectory is not None for stage in whole)


def appeared(now: list[tuple[float, float]], before: list[tuple[float, float]], moved: float) -> bool:
    """Whether something stands now where nothing stood before; what went away is in nobody's way."""
    return any(all(math.dist(p, q) > moved for q in before) for p in now)
