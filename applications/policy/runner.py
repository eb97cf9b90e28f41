"""The task of a cell that a policy controls: starts, ends and hands over; chunks become goals of the executor.

It has no clock and no network. `services/policy_runner.py` requests the chunks and steps it.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from applications.policy.blending import AT_REST, FollowedPath, blended, trajectory_of
from applications.policy.gripping import GripperSchedule
from applications.policy.interface import Chunk, MotionState, ProvedMotion, Violation
from applications.policy.settings import Config, Memory
from applications.policy.topics import PolicyStatus
from common import messages as m
from common.control.trajectory import to_message
from common.hardware.interface import Limits
from common.tasks.commands import obey
from common.tasks.decisions import NOT_ITS_FAULT
from common.tasks.engine import FOUND_HELD, MISSING, NO_ARM, START
from common.tasks.stages import OVER, Command, View

Array = NDArray[np.float64]

COUNTED = ("chunks", "proved", "slowed", "shortened", "refused", "late", "failed")
TOO_LATE = ("too_late", "unknown_goal")  # refusals of a join that came when the motion was nearly or completely over
CLOSE = 0.4  # share of the time between rows: a row that is closer to the join is left out
SETTLED = 0.3  # [s, cell time] a goal that was accepted and is not reported after this time is over


@dataclass(frozen=True)
class Join:
    """Where a chunk takes effect.

    Attributes:
        state: set-point there.
        time: of the path that is followed [s]; 0 for a start from rest.
        rows: (k,) [s] the times of the chunk's rows after the join; those before it are negative.
        before: the motion that is followed; None for a start from rest.
    """

    state: MotionState
    time: float
    rows: Array
    before: FollowedPath | None = None

    @property
    def ahead(self) -> NDArray[np.bool_]:
        """Mask (n,) of the rows after the join that are not too close to it to be targets."""
        spacing = self.rows[1] - self.rows[0] if len(self.rows) > 1 else 0.0
        return self.rows > max(CLOSE * spacing, 2e-3)


@dataclass(frozen=True)
class Pending:
    """A motion that was requested, with widths (k,) [m] of the gripper for cell times (k,) [s]."""

    id: str
    path: FollowedPath
    times: Array
    widths: Array


class PolicyTask:
    """State machine of a policy's task.

    Attributes:
        status: what is published.
        path: the motion that the executor follows, or None.
        pending: request that was not answered yet.
    """

    def __init__(self, config: Config, status: PolicyStatus, prefix: str, limits: Limits) -> None:
        """Start at rest; `prefix` begins the id of every goal and is unique per process."""
        self.p, self.status, self._prefix, self._limits = config, status, prefix, limits
        status.started = config.run.autostart
        self.path: FollowedPath | None = None
        self.pending: Pending | None = None
        self.grip = GripperSchedule(config.cell().gripper_width)
        self.causes: Counter[str] = Counter()
        self._commands: list[Command] = []
        self._ending: tuple[Literal["DONE", "ERROR"], str] | None = None
        self._memory = Memory()
        self._minted = 0
        self._failures = 0  # in a row
        self._found = False  # whether the state of the robot was read, or an operator sent a command
        self._counted = -math.inf  # cell time until which times are counted
        self._accepted_at = -math.inf

    # --- restarts ---------------------------------------------------------------------------------------------------

    @property
    def memory(self) -> Memory:
        """What the task continues with after a restart of its process; another object once that changes."""
        status = self.status
        ended: Literal["", "DONE", "ERROR"] = status.state if status.state in ("DONE", "ERROR") else ""
        now = Memory(control=status.control, operator=status.operator, ended=ended,
                     message=status.message if ended else "", seconds=int(status.task_seconds))
        if now != self._memory:
            self._memory = now
        return self._memory

    def remember(self, memory: Memory) -> None:
        """Continue from the memory of the process before."""
        self._memory, status = memory, self.status
        status.task_seconds = float(memory.seconds)
        if memory.control == "operator":
            self.take(memory.operator)
        if memory.ended:
            status.state, status.message = memory.ended, memory.message
            status.done = status.total = int(memory.ended == "DONE")

    # --- operators ------------------------------------------------------------------------------------------------

    def command(self, command: str, view: View) -> list[Command]:
        """Start, pause, resume or stop. A pause holds the arm on its path; a stop ends the motion."""
        self._found = True

        def restart() -> None:
            self.status.done, self.status.task_seconds = 0, 0.0
            self._ending, self._failures = None, 0

        return obey(command, self.status, restart, lambda reason: [
            m.StopRequest(id=self._leave(), reason=reason, by="operator")])

    def take(self, operator: str) -> None:
        """Give control to an operator: the arm comes to rest on its proved path and waits."""
        self.status.control, self.status.operator = "operator", operator
        self.status.message = f"{operator or 'an operator'} has control"
        self._stop(f"{operator or 'an operator'} took control")

    def give(self) -> None:
        """Give control back to the policy, which continues from where the arm is."""
        self.status.control, self.status.operator, self.status.message = "policy", "", ""
        self._failures = 0
        self.grip.reset()

    def _stop(self, reason: str) -> None:
        if goal := self._leave():
            self._commands.append(m.StopRequest(id=goal, reason=reason, by="requester"))

    def _leave(self) -> str:
        """Forget the motion and what is planned; return the id of its goal."""
        goal = self.pending.id if self.pending else self.path.id if self.path else ""
        if self.pending and self.path:  # it is not known yet which of the two moves the arm
            self._commands.append(m.StopRequest(id=self.path.id, by="requester"))
        self.path = self.pending = None
        self.grip.reset()
        return goal

    # --- answers --------------------------------------------------------------------------------------------------

    def on_plan(self, response: m.PlanResponse, view: View) -> None:
        """Do nothing: it requests no plans."""

    def on_goal(self, answer: m.MotionStatus | m.GripperState, view: View) -> None:
        """Handle whether a goal was accepted."""
        if isinstance(answer, m.GripperState):
            if answer.state == "rejected":
                self.grip.open = None  # command it again
                self.status.message = f"the gripper: {answer.message}"
            return
        if self.pending is None or answer.id != self.pending.id:
            return
        accepted, self.pending = self.pending, None
        if answer.state != "rejected":
            accepted.path.observe(answer)
            self.path, self._accepted_at = accepted.path, view.now
            self.grip.set(accepted.times, accepted.widths)
        elif answer.error in TOO_LATE:
            self.status.late += 1
        elif answer.error not in NOT_ITS_FAULT:
            self.fail(f"a motion was rejected: {answer.message}")

    def fail(self, problem: str) -> None:
        """Count a failure; too many in a row end the episode, unless it is over already."""
        if self._ending is not None or self.status.state in ("DONE", "ERROR"):
            return
        self.status.failures += 1
        self._failures += 1
        self.status.message = problem
        if self._failures >= self.p.most_failures:
            self._end("ERROR", f"{problem} ({self._failures} failures in a row)")

    # --- the step -------------------------------------------------------------------------------------------------

    @property
    def wants_motion(self) -> bool:
        """Whether the task needs the ownership of motion."""
        return self.status.control == "policy"

    def step(self, view: View) -> list[Command]:
        """Return the requests to send now."""
        status = self.status
        if view.missing:
            status.message = f"{MISSING}{', '.join(view.missing)}"
            return []
        if status.message.startswith((MISSING, NO_ARM)):
            status.message = ""
        assert view.motion is not None
        if not self._found:
            self._find(view.motion)
        if view.motion.stopped and status.state not in ("DONE", "ERROR"):
            status.message = view.motion.stopped + START
        elif status.message.endswith(START):
            status.message = ""
        self._follow(view.motion, view)
        self._count(view)
        if self._acts(view):
            status.state = "ACTING"
            if self._is_done(view):
                status.done = status.total = 1
                self._end("DONE", "")
            elif status.task_seconds > self.p.seconds:
                self._end("ERROR", f"not done within {self.p.seconds:g} s")
            elif (width := self.grip.due(view.now)) is not None:
                self._commands.append(m.GripperCommand(id=self._new_id(), width=width))
        elif view.motion.fault and status.started:
            status.message = f"{NO_ARM}{view.motion.fault}"
        if self._ending is not None and view.motion.state != "active" and self.pending is None:
            status.state, status.message = self._ending
            self._ending, status.stage = None, ""
        status.figures = self._figures()
        commands, self._commands = self._commands, []
        return commands

    def _figures(self) -> dict[str, bool | int | float | str | None]:
        status = self.status
        counts = {name: getattr(status, name) for name in COUNTED}
        causes = ", ".join(f"{cause} {count}" for cause, count in self.causes.most_common()) or "none"
        return {**counts, "violations": causes,
                "inference_ms": round(status.inference_ms, 1), "proof_ms": round(status.proof_ms, 1)}

    def _find(self, motion: m.MotionStatus) -> None:
        """Continue as the robot was found at the start of this process."""
        self._found, self.status.paused = True, motion.paused
        if motion.paused:
            self.status.message = FOUND_HELD + "".join(f"; {one.description}" for one in motion.interlocks)
        if motion.stopped:  # an operator stopped it: a restart must not undo that
            self.status.started = self.status.paused = False

    def _follow(self, motion: m.MotionStatus, view: View) -> None:
        """Take from its status where the motion is, or how it ended."""
        path = self.path
        if path is None:
            return
        if motion.id == path.id and motion.state == "active":
            if motion.header.stamp * 1e-9 > path.known[0]:
                path.observe(motion)
            return
        if motion.id != path.id and view.now - self._accepted_at < SETTLED:
            return  # reported before it was accepted
        self.path = None
        if motion.id != path.id or motion.state not in OVER:
            return
        if motion.state == "succeeded":
            return
        self.grip.reset()
        if motion.state == "aborted":
            self.fail(f"the motion was aborted: {motion.message}")
        elif motion.stopped:
            self.status.started = False
        else:
            self.status.paused = True
            self.status.message = f"the motion was stopped from outside ({motion.message}); resume to go on"

    def _acts(self, view: View) -> bool:
        """Return whether the policy may move the arm now."""
        status, motion = self.status, view.motion
        return bool(motion is not None and status.started and not status.paused and status.control == "policy"
                    and status.state not in ("DONE", "ERROR") and self._ending is None
                    and not (motion.stopped or motion.held or motion.fault))

    def _count(self, view: View) -> None:
        since, self._counted = view.now - self._counted, view.now
        if not 0.0 < since < 1.0 or not self._acts(view):
            return
        self.status.task_seconds += since
        if self.path is not None:
            self.status.moving_seconds += since

    def _is_done(self, view: View) -> bool:
        until = self.p.until
        return (until.holding or until.height is not None) and (view.holding or not until.holding) and (
            until.height is None or view.tool[2] >= until.height)

    def _end(self, state: Literal["DONE", "ERROR"], message: str) -> None:
        """End the episode once the arm is at rest."""
        if self._ending is None:
            self.status.state, self.status.message, self._ending = "ENDING", message, (state, message)
            self._stop(message or "the episode is done")

    # --- chunks ---------------------------------------------------------------------------------------------------

    def wants_chunk(self, view: View) -> bool:
        """Return whether a chunk that arrives now could move the arm."""
        assert view.motion is not None
        idle = view.motion.state != "active" or (self.path is not None and self.path.id == view.motion.id)
        return self._acts(view) and self.pending is None and idle and not view.trouble

    def expected_join(self, now: float, delay: float) -> float | None:
        """Return the time of the path [s] until which it is committed if a chunk takes a delay [s, cell time].

        None without a motion.
        """
        return None if self.path is None else self.path.time(now) + (delay + self.p.margin) * self.path.rate

    def join(
        self, chunk: Chunk, rows: int, view: View, at_rest: bool, delay: float, earliest: float | None
    ) -> Join | None:
        """Return where a chunk takes effect; None if it is too late, or the arm is just coming to rest.

        Args:
            chunk: what the policy returned.
            rows: their number.
            view: what is known now.
            at_rest: whether the arm was at rest when it was observed.
            delay: until the motion is requested [s, cell time].
            earliest: time of the path that was committed when the policy was asked [s].
        """
        after = np.arange(1, rows + 1) / chunk.rate
        if self.path is None:
            assert view.q is not None and view.motion is not None
            if view.motion.state == "active":
                return None
            q = np.array(view.q)
            passed = 0.0 if at_rest else view.now - chunk.stamp * 1e-9
            return Join(MotionState(q, 0 * q, 0 * q), 0.0, after - passed)
        expected = self.expected_join(view.now, delay)
        assert expected is not None
        time = max(expected, earliest or 0.0)
        if time > self.path.path.duration - AT_REST or self.path.rate == 0.0:
            return None
        return Join(self.path.state(time), time, self.path.time(chunk.stamp * 1e-9) + after - time, self.path)

    def blended(self, rows: Array, join: Join) -> Array:
        """Return the rows after the join (k, dof) [rad], blended with the motion before it."""
        if join.before is None:
            return rows[join.ahead]
        return blended(rows[join.ahead], join.rows[join.ahead], join.before, join.time, self.p.blend)

    def send(self, motion: ProvedMotion, join: Join, widths: Array | None, view: View, of: int) -> None:
        """Request a proved motion of a chunk with `of` rows after the join, unless none of them is followed."""
        status, violation = self.status, motion.violation
        if violation is not None:
            self.causes[violation.cause] += 1
            status.violation, status.cause = violation.message, violation.cause
        if motion.rows == 0 or len(motion.times) < 2:
            status.refused += 1
            self._hand_over(violation)
            return
        self._failures = 0
        if motion.slowed > 1.0:
            status.slowed += 1
        if motion.rows < of:
            status.shortened += 1
        else:
            status.proved += 1
        if join.before is not self.path or not self.wants_chunk(view):
            return  # it ended, or an operator acted meanwhile
        trajectory = trajectory_of(motion, self._limits)
        request = m.ExecuteRequest(
            id=self._new_id(), trajectory=to_message(trajectory, self._limits.names),
            scene_stamp=view.scene.header.stamp if view.scene else 0)
        if join.before is None:
            path = FollowedPath(request.id, trajectory, 0.0, motion.moving)
        else:
            request.joins, request.join_time = join.before.id, join.time - join.before.begin
            path = join.before.followed_by(request.id, join.time, trajectory, motion.moving)
        rate = 1.0 if join.before is None else max(join.before.rate, 1e-3)
        joins = view.now if join.before is None else view.now + (join.time - join.before.time(view.now)) / rate
        times = join.rows * motion.slowed
        followed = join.ahead & (times < motion.moving + 1e-3) if widths is not None else np.zeros(len(times), bool)
        self.pending = Pending(request.id, path, joins + times[followed] / rate,
                               np.zeros(0) if widths is None else widths[followed])
        status.stage = request.id
        self._commands.append(request)

    def _hand_over(self, violation: Violation | None) -> None:
        if self.p.on_violation == "refuse" and violation is not None:
            self.take("")
            self.status.message = f"the operator has control: {violation.message}"

    def _new_id(self) -> str:
        self._minted += 1
        return f"{self._prefix}-{self._minted}"
