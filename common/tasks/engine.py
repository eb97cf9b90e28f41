"""The task engine: takes what is known, returns requests for motion. A task of the user only decides.

The engine works through one queue of stages. It plans later motions while the first stage runs, each from the end of
the motion before. When reality differs from the plan (empty grasp, lost object, changed scene, rejected command) it
clears the queue, and the task decides again from what is seen and held. A restarted task continues the same way.

The engine has no clock and no network: `step`, `command` and the `on_...` methods feed it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import takewhile

from common import messages as m
from common.robot.transforms import rpy_to_matrix
from common.tasks.commands import obey
from common.tasks.decisions import NOT_ITS_FAULT, V
from common.tasks.force import ForceMove
from common.tasks.monitoring import ExecutionMonitor
from common.tasks.signals import Output, WaitFor
from common.tasks.stages import AwaitImage, Command, Execution, Grip, Move, Report, Stage

START = ": start to go on"
MISSING = "waiting for "
NO_ARM = "the arm cannot be moved: "
FOUND_HELD = "the robot was found held; resume or start to go on"
FINGERS_OFF = 0.003  # [m] tolerated difference between the finger width now and the one of the plan
LOOSE = 0.5e-3  # [m] opening after which the fingers hold nothing any more
AHEAD = 1.0  # [s] before the end of a motion: earliest time to send a gripper command that waits for it
CLOSE_WITHIN = 0.05  # [m] from the end of the motion the fingers may start to close, touching nothing
MOST_FIGURES = 200  # plans in a status: a cell may run for days


class Task(ExecutionMonitor[V]):
    """State machine of a task. Implement `decide`; override other hooks where the task differs.

    A task uses `queue` (to which `decide` appends stages), `running` (the running stage), `status`, `wait_timer` (time
    spent waiting) and all hooks and helpers of `TaskDecisions`.
    """

    # --- commands of the operator ----------------------------------------------------------------------------

    def command(self, command: str, view: V) -> list[Command]:
        """Start, pause, resume or stop. A pause holds the arm on its path; a stop ends the motion."""
        self.wait_timer.reset()
        self._found = True

        def restart() -> None:
            self._began, self._failures_in_a_row = None, 0
            self._again_at = -math.inf
            self.on_restart()

        return obey(command, self.status, restart, lambda reason: (
            self.stop(view, reason, "operator") or [m.StopRequest(reason=reason)]))

    # --- answers ---------------------------------------------------------------------------------------------

    def on_plan(self, response: m.PlanResponse, view: V) -> None:
        """Handle the answer to a plan request."""
        if self._planning is None or self._planning[1] != response.id:
            return  # a plan for a cleared queue
        move, _ = self._planning
        self._planning = None
        self._note_plan(response)
        self.planned(move, response)
        if response.ok and response.trajectory is not None and response.trajectory.points:
            move.trajectory, move.plan, move.scene_stamp = response.trajectory, response.id, response.scene_stamp
        elif move.fallback and move in self.queue and not response.error.startswith("start_"):
            at = self.queue.index(move)
            self.queue.remove(move)
            for stage in reversed(move.fallback):
                self.queue.insert(at, stage)
        else:
            self.plan_failed(move, response, view)

    def _note_plan(self, response: m.PlanResponse) -> None:
        """Record its time, and its planner when it returned a trajectory."""
        self.status.planning_seconds += response.seconds
        if response.ok and response.trajectory is not None:
            self.status.plans.append(m.PlanFigure(
                planner=response.planner, seconds=response.seconds, fraction=response.fraction,
                attempts=max(1, len(response.attempts)),
            ))
            del self.status.plans[:-MOST_FIGURES]

    def on_goal(self, answer: Report, view: V) -> None:
        """Handle the answer to an execute or gripper request: accepted, or rejected with a reason."""
        execution = next((one for one in (self.running, self._early) if one and one.command.id == answer.id), None)
        if execution is None or execution.accept(answer):
            return
        stage = execution.stage
        if execution is self._early:  # then send it when the arm is at rest
            assert isinstance(stage, Grip)
            self._early, stage.early = None, False
            if self.running is not None:
                self.queue.appendleft(stage)
            return
        self.running = None
        # Rejected because of another client or a late request, not because of the motion: no failure.
        if answer.error in NOT_ITS_FAULT:
            self._decide_again(f"{stage.name} has to wait: {answer.message}", view)
            return
        problem = f"{stage.name} was refused: {answer.message}"
        if isinstance(answer, m.MotionStatus) and answer.error == "start_mismatch":
            self.displaced(stage, view, problem)
        else:
            self.fail(problem, view)

    # --- the step --------------------------------------------------------------------------------------------

    def step(self, view: V) -> list[Command]:
        """Return the requests to send now."""
        status = self.status
        if view.missing:
            status.message = f"{MISSING}{', '.join(view.missing)}"
            return []
        if status.message.startswith(MISSING):
            status.message = ""
        assert view.motion is not None and view.gripper is not None
        if not self._found:
            self._found, status.paused = True, view.motion.paused
            if view.motion.paused:
                status.message = FOUND_HELD + "".join(f"; {one.description}" for one in view.motion.interlocks)
            if view.motion.stopped:  # an operator stopped it: a restart must not undo that
                status.started = status.paused = False
            if view.holding or view.motion.state == "active":  # an earlier process of the task moved something
                self.images_after = view.now
        self._report_stopped(view.motion.stopped)
        if self._began is None and status.started:
            self._began = view.now
        if self._early is not None and view.gripper.id == self._early.command.id:
            self._early.started = self._early.started or view.gripper.state != "cancelled"
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
        while self.running is None and self.queue and isinstance(self.queue[0], AwaitImage):
            self.queue.popleft()
            self.images_after = view.now
        if self.running is not None:
            self.decide_ahead(self.running.stage, view)
        elif not (self.queue or self._early or view.motion.state == "active" or view.gripper.moving):
            shut, self._shut = self._shut, False  # not before the gripper command of an earlier task process has ended
            if shut and not view.holding:
                self.queue.append(Grip("open", status.state, width=self.gripper.max_width))
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

    def _report_stopped(self, stopped: str) -> None:
        if stopped and self.status.state not in ("DONE", "ERROR"):
            self.status.message = stopped + START
        elif self.status.message.endswith(START):
            self.status.message = ""

    # --- planning and execution ------------------------------------------------------------------------------

    def _plan_ahead(self, view: V) -> Iterator[Command]:
        """Request a plan for the first motion without a trajectory, from the end of the motion before it."""
        running = self.running.stage if self.running else None
        if self._planning is not None or isinstance(running, ForceMove):  # only the force decides where it ends
            return
        end = running.end() if isinstance(running, Move) else []
        width = self._width(view)
        for grip in (running, self._early.stage if self._early else None):
            if width is not None and isinstance(grip, Grip):
                width = grip.width_after(width)
        for move in self.queue:
            if width is not None and isinstance(move, Grip):
                width = move.width_after(width)
            if not isinstance(move, Move):
                continue
            if isinstance(move, ForceMove):
                if move is not self.queue[0] or running is not None or self._early is not None or view.tcp is None:
                    return  # its line begins where the tool is then
                move.aim(view, rpy_to_matrix(*self.p.robot.base_rpy))
            if move.trajectory is None:
                move.planned_around, move.planned_width = self.obstacles(move, view), width
                request = self.request(move, end, view)
                if request.gripper_width is None:
                    request.gripper_width = width
                self._planning = (move, request.id)
                yield request
                return
            end = move.end()
            if isinstance(move, ForceMove):
                return

    def _advance(self, view: V) -> Iterator[Command]:
        """Start the next stage once the one before has ended and its plan is still valid."""
        if self.running is not None:
            yield from self._begin_early(self.running, view)
        if self.running is not None or self._early is not None or not self.queue:
            return
        stage = self.queue[0]
        if isinstance(stage, Output | WaitFor):
            if self.may_start(stage, view):
                yield from self._run_signal(stage, view)
            return
        if stage.carries and not view.holding:
            self.fail(f"what the hand held fell before {stage.name}", view, go_home=False)
            return
        if (isinstance(stage, Move) and not self._is_planned(stage)) or not self.may_start(stage, view):
            return
        if isinstance(stage, Move) and not self._may_use(stage, view):
            return
        if isinstance(stage, Move) and (
            appeared(self.obstacles(stage, view), stage.planned_around, self.moved) or self._fingers_differ(stage, view)
        ):
            for later in self.queue:
                if isinstance(later, Move):
                    later.trajectory = None
            self._planning = None
            yield from self._plan_ahead(view)
            return
        yield self._begin(stage, view)

    def _begin_early(self, running: Execution, view: V) -> Iterator[Command]:
        """Send a gripper command before the arm is at standstill; the executor starts it just before the end."""
        stage, arm = (self.queue[0] if self.queue else None), running.stage
        if not (isinstance(stage, Grip) and stage.early and isinstance(arm, Move)) or self._opening or self._early:
            return
        if stage.holds and self._held_up and not stage.lead:  # with a lead the object moves with the arm
            return
        assert view.motion is not None and view.gripper is not None
        motion = view.motion
        if motion.id != running.command.id or motion.state != "active":
            return
        left = (1.0 - motion.progress) * arm.seconds
        due = left - stage.lead <= AHEAD * motion.speed_scaling
        if due and stage.carries == view.holding and self.may_start(stage, view):
            self.queue.popleft()
            self._early = self._execution(stage, view)
            self._early.started = False
            command = self._early.command
            assert isinstance(command, m.GripperCommand)
            command.after = running.command.id
            if stage.lead:
                command.lead, command.within = stage.lead, 1.0
            elif stage.holds:
                way = 0.0 if stage.expected_width is None else view.gripper.width - stage.expected_width
                command.lead, command.within = min(self.gripper.least_time(way), AHEAD), CLOSE_WITHIN
            else:
                command.lead = min(self.gripper.least_time(LOOSE), AHEAD)
            yield command

    def _width(self, view: V) -> float | None:
        """Finger width now, or after a running opening [m]; None for a gripper without finger joints."""
        gripper = self.p.robot.gripper
        if gripper is None or not gripper.joints or view.gripper is None:
            return None
        width = view.gripper.width
        if self._opening is not None and isinstance(self._opening.stage, Grip):
            width = max(width, self._opening.stage.width)
        return min(max(width, 0.0), gripper.max_width)

    def _fingers_differ(self, move: Move, view: V) -> bool:
        """Return whether the fingers are not as planned; on a held object they may be closer."""
        width, planned = self._width(view), move.planned_width
        if width is None or planned is None:
            return False
        return width > planned + FINGERS_OFF or (width < planned - FINGERS_OFF and not move.carries)

    def _begin(self, stage: Stage, view: V) -> Command:
        self.queue.popleft()
        self.running = self._execution(stage, view)
        self._report_stage(stage)
        return self.running.command

    def _execution(self, stage: Stage, view: V) -> Execution:
        command: m.ExecuteRequest | m.GripperCommand
        if isinstance(stage, Move):
            command = stage.execution(self.new_id())
        else:
            assert isinstance(stage, Grip)
            command = m.GripperCommand(id=self.new_id(), width=stage.width, effort=stage.effort, mass=stage.mass)
            if stage.expected_width is not None:
                command.expected_width, command.width_tolerance = stage.expected_width, stage.width_tolerance
        if stage.cycle is not None:
            stage.cycle.started = True
        execution = Execution(stage, command, view.now)
        assert view.motion is not None and view.gripper is not None
        if isinstance(stage, Grip):
            self._opening = None  # the new command replaces it
            execution.held = view.gripper.width if view.holding else None
        execution.before = execution.report(view.motion, view.gripper).id
        return execution

    def _is_planned(self, move: Move) -> bool:
        needed = [move]
        if move.needs_full_plan:
            known = takewhile(lambda stage: not isinstance(stage, ForceMove), self.queue)  # until a force decides
            needed = [stage for stage in known if isinstance(stage, Move) and stage.cycle is move.cycle]
        return all(stage.trajectory is not None for stage in needed)


def appeared(now: list[tuple[float, float]], before: list[tuple[float, float]], moved: float) -> bool:
    """Return whether an object is now where none was before; objects that disappeared do not matter."""
    return any(all(math.dist(p, q) > moved for q in before) for p in now)
