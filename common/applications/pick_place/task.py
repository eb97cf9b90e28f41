"""The pick-and-place task: what was seen and reported goes in, requests for motion come out.

One row of stages is worked off from the left. Motions further right are planned while the one on the left runs, each
from where the one before it ends. When reality differs from the plan (the ball moved, the fingers closed on nothing,
the ball fell, the scene changed) the rest of the row is thrown away and chosen anew from what is seen and held, which
is also how the task carries on after a restart in the middle of a run.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

from common import messages as m
from common.applications.pick_place.choice import Choice
from common.applications.pick_place.messages import PickPlaceStatus
from common.applications.pick_place.parameters import PickPlaceParameters
from common.applications.pick_place.rows import Rows
from common.applications.pick_place.stages import Command, Cycle, Grip, Move, Stage, Target, View, appeared
from common.config import Grasp, GripperConfig, Surroundings
from common.tasks.execution import ANEW, FOUND_HELD, Execution, Report, note_plan
from common.tasks.pictures import Pictures


class PickPlace:
    """State machine of the task. Feed it with `step` and the `on_...` methods; it has no clock and no network."""

    def __init__(
        self, parameters: PickPlaceParameters, grasp: Grasp, around: Surroundings, gripper: GripperConfig, prefix: str,
        started: bool = True, speed: float = 1.0,
    ) -> None:
        """Start from nothing known.

        Args:
            parameters: times, tolerances and counts, read where they are used: they may change meanwhile.
            grasp: heights of approach, lift and release.
            around: the container and the size of a ball.
            gripper: its links and its width.
            prefix: begins every id that is minted here; unlike that of any other process.
            started: whether to begin without being told.
            speed: cell time that passes per wall time.
        """
        self.p, self.around, self.gripper, self.prefix = parameters, around, gripper, prefix
        self._pictures = Pictures(speed)
        self.rows = Rows(grasp, around, gripper, parameters)
        self.choice = Choice(parameters, around.container, around.ball_radius)
        self.status = PickPlaceStatus(started=started)
        self._stages: deque[Stage] = deque()
        self._running: Execution[Stage] | None = None
        self._stopping = False
        self._planning: tuple[Move, str] | None = None
        self._minted = 0
        self._look_after = 0.0  # only a later picture decides
        self._quiet: tuple[float, bool] | None = None  # since which picture, and whether something is left
        self._began: float | None = None
        self._looked = False
        self._found = False  # whether the robot was looked at, or a person has said what to do
        self._failures_in_a_row = 0

    # --- what a person says ----------------------------------------------------------------------------------

    def command(self, command: str, view: View) -> list[Command]:
        """Start, pause, resume or stop: a pause holds the arm on its path, from which it goes on; a stop ends that."""
        status = self.status
        self._quiet, self._found = None, True
        if command == "pause":
            status.paused = True
            return [m.HoldRequest(hold=True, reason="the task is paused")]
        reason = f"the task was told to {command}"
        if command in ("start", "resume"):
            status.started, status.paused = status.started or command == "start", False
            if command == "start" and status.state in ("DONE", "ERROR"):
                status.state, self._failures_in_a_row = "IDLE", 0
            return [m.HoldRequest(hold=False, reason=reason)]
        status.paused = status.started = False
        return self._stop(view, reason) or [m.StopRequest(reason=reason)]

    # --- answers ---------------------------------------------------------------------------------------------

    def on_plan(self, response: m.PlanResponse, view: View) -> None:
        """Take in the answer to a plan request."""
        if self._planning is None or self._planning[1] != response.id:
            return  # of a row of stages that was thrown away meanwhile
        move, _ = self._planning
        self._planning = None
        note_plan(self.status, response)
        if not response.ok or response.trajectory is None:
            self._plan_failed(move, response, view)
            return
        move.trajectory = response.trajectory

    def on_goal(self, answer: m.MotionStatus | m.GripperState, view: View) -> None:
        """Take in the answer to execute or to a gripper command: accepted, or refused with a reason."""
        if self._running is None or self._running.command.id != answer.id or self._running.accept(answer):
            return
        stage, self._running = self._running.stage, None
        # What somebody else asked for, or that it came too late, is no failure: it is decided anew.
        if isinstance(answer, m.MotionStatus) and answer.error in ANEW:
            self._clear()
            self._look_after = view.now
            self.status.message = f"{stage.name} has to wait: {answer.message}"
            return
        # A robot that is not where the plan began only needs a new plan.
        stale = isinstance(answer, m.MotionStatus) and answer.error == "start_mismatch"
        self._fail(f"{stage.name} was refused: {answer.message}", view, go_home=not stale)

    # --- the step --------------------------------------------------------------------------------------------

    def step(self, view: View) -> list[Command]:
        """What to ask for now, given what is known."""
        if view.missing:
            self.status.message = f"waiting for {', '.join(view.missing)}"
            return []
        assert view.motion is not None and view.gripper is not None
        if not self._looked:
            # Balls in the container were placed before a restart, or by somebody else.
            self._looked, self.status.done = True, len(view.objects("contained"))
        if not self._found:
            self._found, self.status.paused = True, view.motion.paused
            if view.motion.paused:
                self.status.message = FOUND_HELD
        if self._began is None and self.status.started:
            self._began = view.now
        commands = self._watch(view)
        self._stopping = self._stopping and view.motion.state == "active"
        waiting = self.status.paused or view.motion.held or not self.status.started or self.status.state == "ERROR"
        if commands or self._stopping or waiting:
            return commands
        if self._running is None and not self._stages:
            if view.motion.state == "active" or view.gripper.moving:
                return []  # what a task before this one began is let finish
            self._decide(view)
        elif self._running is not None and self._running.stage.name == "across" and not self._waiting_cycle():
            self._queue_next(view)
        if self.status.state != "DONE":
            self.status.task_seconds = view.now - (self._began or view.now)
        self.status.skipped = self.choice.rejections()
        if self.status.stage not in ("close", "lift", "across", "release"):  # then one is in the hand or in the air
            self.status.total = self.status.done + len(view.targets)
        return [*self._plan_ahead(view), *(() if view.trouble else self._advance(view))]

    # --- what runs -------------------------------------------------------------------------------------------

    def _watch(self, view: View) -> list[Command]:
        """Follow the stage that runs: its end, its failure, and a ball that falls out of the hand."""
        if self._running is None:
            return []
        assert view.motion is not None and view.gripper is not None
        running, stage = self._running, self._running.stage
        running.count(view.now, view.motion)
        outcome = running.outcome(view.motion, view.gripper)
        if outcome == "ended":
            self._running = None
            self.status.moving_seconds += running.moving
            self._ended(stage, running.report(view.motion, view.gripper), view)
        elif outcome == "forgotten":
            self._running = None
            self._fail(f"{stage.name} was forgotten by the controller", view)
        elif isinstance(stage, Move) and stage.carries and not view.holding:
            stop = self._stop(view, "the ball fell")
            self._fail(f"the ball fell during {stage.name}", view, go_home=False)
            return stop
        elif running.spent > self.p.goal_timeout:
            stop = self._stop(view, "it takes too long")
            self._fail(f"{stage.name} took longer than {self.p.goal_timeout:g} s", view)
            return stop
        return []

    def _ended(self, stage: Stage, reported: Report, view: View) -> None:
        if reported.state == "cancelled" and isinstance(stage, Move):
            self._clear()
            self.status.paused = True
            self.status.message = f"{stage.name} was stopped from outside ({reported.message}); resume to go on"
        elif reported.state != "succeeded":
            self._fail(f"{stage.name} {reported.state}: {reported.message}", view)
        elif stage.name in ("home", "retreat"):
            self._look_after = view.now
        elif stage.name == "close" and not view.holding and stage.cycle:
            self._missed(stage.cycle, view)
        elif stage.name == "release" and stage.cycle:
            if view.holding:
                self._fail("the fingers opened and still hold something", view)
                return
            self.status.done += 1
            self._failures_in_a_row = 0
            self.choice.released(stage.cycle.target, view)

    def _missed(self, cycle: Cycle, view: View) -> None:
        """The fingers closed on nothing: open, go up and look again."""
        self.status.retries += 1
        x, y, _ = cycle.target.position
        self.status.message = f"the fingers closed on nothing at ({x:.3f}, {y:.3f})"
        self.choice.missed(cycle.target, view)
        self._clear()
        self._stages += [self.rows.open(None), self.rows.retreat(view)]
        self._look_after = view.now

    # --- failure ---------------------------------------------------------------------------------------------

    def _fail(self, message: str, view: View, *, go_home: bool = True) -> None:
        """Count a failure, throw the row away and, where it helps, go home to look again."""
        self._clear()
        self._look_after = view.now
        self.status.message = message
        self.status.failures += 1
        self._failures_in_a_row += 1
        if self._failures_in_a_row >= self.p.max_failures:
            self.status.state = "ERROR"
            self.status.message = f"{message}; that makes {self._failures_in_a_row} failures in a row"
        elif go_home:
            self._stages.append(self.rows.home(view))

    def _plan_failed(self, move: Move, response: m.PlanResponse, view: View) -> None:
        cycle = move.cycle
        if response.error == "start_in_collision" and response.colliding and self._running is None and (
            move.name != "retreat"
        ):
            self._fail(response.message, view, go_home=False)
            if self.status.state != "ERROR":
                self._stages.append(self.rows.retreat(view, response.colliding))
        elif cycle is not None and not cycle.begun:
            cycle.first_error = cycle.first_error or response.message
            self._stages = deque(s for s in self._stages if s.cycle is not cycle or s.name == "open")
            if cycle.yaws:
                self._stages += self.rows.pick_and_place(cycle)
            else:
                self.choice.give_up(cycle.target, cycle.first_error, view)
        elif self._running is None:
            self._fail(response.message, view, go_home=move.name != "home")
        else:
            # What runs is sound; what was to follow is chosen anew when it has ended.
            self._fail(response.message, view, go_home=False)

    def _clear(self) -> None:
        self._stages.clear()
        self._planning = None

    def _stop(self, view: View, reason: str) -> list[Command]:
        """Forget the row of stages and bring the arm to rest; fingers finish what they began."""
        self._clear()
        self._look_after = view.now
        if self._running is None or not self._running.moves_arm:
            return []
        running, self._running, self._stopping = self._running, None, True
        self.status.moving_seconds += running.moving
        return [m.StopRequest(id=running.command.id, reason=reason)]

    # --- what to do next -------------------------------------------------------------------------------------

    def _decide(self, view: View) -> None:
        """With nothing under way: carry what is held to the container, take the nearest ball, or find an end."""
        assert view.tcp is not None
        if view.holding:
            if view.attached:  # else the planning scene has not caught up yet
                held = Cycle(Target(view.attached, view.tcp), begun=True)
                self._stages += self.rows.place_held(held, view.tcp)
        elif not self._queue_next(view):
            self._wait_for_the_end(view)

    def _waiting_cycle(self) -> bool:
        return any(stage.cycle is not None and not stage.cycle.begun for stage in self._stages)

    def _queue_next(self, view: View) -> bool:
        """Append the stages for the nearest ball that can be taken; whether there is one."""
        assert view.tcp is not None and view.gripper is not None
        if min(view.targets_stamp, view.scene_stamp) <= self._look_after or self._unseen(view):
            return False
        under_way = [self._running.stage.cycle] if self._running and self._running.stage.cycle else []
        box = self.around.container
        cycle = self.choice.next(view, (box.x, box.y) if under_way else view.tcp, under_way)
        if cycle is None:
            return False
        if not under_way and view.gripper.width < self.gripper.max_width - 0.002:
            self._stages.append(self.rows.open(cycle))
        self._stages += self.rows.pick_and_place(cycle)
        self._quiet, self.status.message = None, ""
        return True

    def _wait_for_the_end(self, view: View) -> None:
        """DONE after a moment with an empty table, or after the grace period when something can not be taken."""
        if self.status.state == "DONE":
            return
        left = max(len(view.balls()), len(view.targets))  # one of the two may have just begun to look
        # Time of pictures, not of the clock: that nobody looks any more is no sign of an empty table.
        seen = max(self._look_after, min(view.targets_stamp, view.scene_stamp))
        if unseen := self._unseen(view):
            self._quiet, self.status.message = None, unseen
        elif self._quiet is None or self._quiet[1] != bool(left):
            self._quiet = (seen, bool(left))
            self.status.message = f"{left} objects are left that can not be taken" if left else "the table looks empty"
        done = self._quiet is not None and seen - self._quiet[0] >= (self.p.grace if left else self.p.empty)
        self.status.state, self.status.stage, self.status.subject = "DONE" if done else "IDLE", "", ""

    # --- planning and doing ----------------------------------------------------------------------------------

    def _plan_ahead(self, view: View) -> Iterator[Command]:
        """Ask for the first motion that has no trajectory, from where the one before it ends."""
        if self._planning is not None:
            return
        running = self._running.stage if self._running else None
        end = running.end() if isinstance(running, Move) else []
        for move in self._stages:
            if not isinstance(move, Move):
                continue
            if move.trajectory is None:
                yield self._request(move, end, view)
                return
            end = move.end()

    def _request(self, move: Move, start: list[float], view: View) -> m.PlanRequest:
        target, in_hand = self._object_of(move, view)
        allowed = list(move.allowed)
        if move.touches_target:
            allowed += [(link, target) for link in self.gripper.links]
        move.planned_around = view.spots(move.cycle.target if move.cycle else None, self.around.ball_radius)
        attach_pose = self.rows.attach_pose(move.cycle) if move.carries and move.cycle and not in_hand else None
        request = m.PlanRequest(
            id=self._mint(), stage=move.name, start=start, goal=move.goal, straight=move.straight,
            allowed_collisions=allowed, attach=target if move.carries else "", attach_pose=attach_pose,
            release=not move.carries, planning_time=self.p.planning_time,
        )
        self._planning = (move, request.id)
        return request

    def _object_of(self, move: Move, view: View) -> tuple[str, bool]:
        """The track id of a move's object, and whether it is in the hand now.

        Ids are looked up by place, because the scene manager may have been restarted since the object was chosen.
        """
        if view.holding and view.attached and (move.cycle is None or move.cycle.begun):
            return view.attached, True
        if move.cycle is None:
            return "", False
        place = move.cycle.target.position[:2]
        near = min(view.balls(), key=lambda b: math.dist(b.position[:2], place), default=move.cycle.target)
        is_it = math.dist(near.position[:2], place) < self.around.ball_radius
        return (near if is_it else move.cycle.target).id, False

    def _advance(self, view: View) -> Iterator[Command]:
        """Begin the next stage when the one before it has ended and its motion is planned and still right."""
        if self._running is not None or not self._stages:
            return
        stage = self._stages[0]
        needs_ball = stage.carries if isinstance(stage, Move) else stage.name == "release"
        if needs_ball and not view.holding:
            self._fail(f"the ball fell before {stage.name}", view, go_home=False)
            return
        if isinstance(stage, Move):
            if not self._is_planned(stage):
                return
            if stage.name in ("pre-grasp", "descend"):
                if unseen := self._unseen(view):
                    self.status.message = f"{stage.name} waits: {unseen}"
                    return
                if self.status.message.startswith(f"{stage.name} waits"):
                    self.status.message = ""
                if not self._is_still_there(stage, view):
                    self.status.message = f"{stage.name}: the ball is no longer where it was seen"
                    self._clear()
                    return
            spots = view.spots(stage.cycle.target if stage.cycle else None, self.around.ball_radius)
            if appeared(spots, stage.planned_around, self.p.moved):
                for later in self._stages:
                    if isinstance(later, Move):
                        later.trajectory = None
                self._planning = None
                yield from self._plan_ahead(view)
                return
        self._stages.popleft()
        if stage.cycle is not None and stage.name != "open":
            stage.cycle.begun = True
        command: m.ExecuteRequest | m.GripperCommand
        if isinstance(stage, Grip):
            command = m.GripperCommand(id=self._mint(), width=stage.width)
        else:
            assert stage.trajectory is not None
            command = m.ExecuteRequest(id=self._mint(), trajectory=stage.trajectory)
        self._running = Execution(stage, command, view.now)
        self.status.state, self.status.stage = stage.state, stage.name
        self.status.subject = stage.cycle.target.id if stage.cycle else ""
        yield command

    def _is_planned(self, move: Move) -> bool:
        """Whether it can begin: a pre-grasp only together with the whole way to the container."""
        whole = [s for s in self._stages if isinstance(s, Move) and s.cycle is move.cycle]
        return all(s.trajectory is not None for s in (whole if move.name == "pre-grasp" else [move]))

    def _is_still_there(self, move: Move, view: View) -> bool:
        """Whether the target is seen where it was when its motions were planned."""
        place = move.cycle.target.position if move.cycle else (0.0, 0.0, 0.0)
        return any(math.dist(t[:2], place[:2]) <= self.p.moved for t in view.targets)

    def _unseen(self, view: View) -> str:
        """Why the newest picture can not be decided by; empty when it can."""
        stamps = (view.targets_stamp, view.scene_stamp)
        return self._pictures.problem(view.now, stamps, self.p.frame_timeout, self.p.clock_tolerance)

    def _mint(self) -> str:
        self._minted += 1
        return f"{self.prefix}-{self._minted}"
