"""Motions that a person asks for: planned from where the robot is, executed, waited for. Never against a task.

A person moves the robot while no task wants to: it was not started or was stopped, it is idle, or it has ended. A task
that has begun must be stopped first, also one that is paused, since its motion is only held. Should a task begin at the
same moment, the executor lets one of the two move the robot, and a task waits for the end of what it did not ask for.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from common import messages as m
from common import topics
from common.application import applications
from common.config import check
from common.errors import ConfigError, RequestFailed, RequestLost, ZencellError
from common.time_source import new_id, wall_ns
from common.transport.bus import Bus
from common.transport.reader import Reader

log = logging.getLogger(__name__)

PLANNING_TIME = 5.0  # [s] wall
SLOWER = 15.0  # [s] wall for the answer besides: what is planned for somebody else comes first
REQUEST_TIMEOUT = 2.0  # [s] wall
PATIENCE = 10.0  # [s] wall without progress, unless the robot is held
FIRST_WORD = 0.5  # [s] wall in which a state that there is has arrived
COME_TO_REST = 1.0  # [s] wall: for a motion that is being stopped
OURSELVES = ("watchdog", "controller", "scene_monitor")  # release their holds by themselves
AT_REST = ("IDLE", "DONE", "ERROR")  # states in which a task does not move the robot

A = TypeVar("A", bound=m.Message)

Goal = m.AnyGoal


class MotionFailed(ZencellError):
    """A motion that was refused, or did not get to its end: `code` is for programs, the line for the person."""

    exit_code = 1

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class OperatorMotion:
    """Moves the robot for a person; any number of these may live in a cell, the executor follows one goal at a time."""

    def __init__(
        self, bus: Bus, tasks: Sequence[Reader[Any]] | None = None, owner: str | Callable[[], str] = m.UNKNOWN_OPERATOR
    ) -> None:
        """Declare what is asked and heard.

        Args:
            bus: in the cell.
            tasks: readers of what the cell's tasks say of themselves (a `TaskStatus`); all that there may be if None.
            owner: name of the person, or what says who asks now, whose own stops and holds, and nobody else's, do not
                keep the robot.
        """
        self._owner = owner if callable(owner) else lambda: owner
        self._bus = bus
        self._plan, self._execute = bus.client(topics.MOTION_PLAN), bus.client(topics.MOTION_EXECUTE)
        self._stop, self._hold = bus.client(topics.MOTION_STOP), bus.client(topics.MOTION_HOLD)
        self._motion = bus.reader(topics.MOTION_STATUS)
        if tasks is None:
            tasks = [bus.reader(found.status) for found in applications()]
        self._tasks = tasks

    async def plan(self, goal: Goal, **more: Any) -> m.PlanResponse:
        """A trajectory from where the robot is, or what is in its way; nothing moves.

        Args:
            goal: where to.
            more: other fields of a `PlanRequest`, such as planner and straight.

        Raises:
            ConfigError: a field that is not one, or cannot be used.
            RequestFailed: the planner does not answer, or does not know the scene or the robot's state yet.
        """
        fields = {"id": _mint(), "stage": "operator", "goal": goal, "planning_time": PLANNING_TIME, **more}
        request = check(m.PlanRequest, fields, "plan")
        return await self._plan.call(request, (request.planning_time or PLANNING_TIME) + SLOWER)

    async def move(
        self, goal: Goal, *, timeout: float = PATIENCE, acknowledged: int | None = None, **more: Any
    ) -> m.MotionStatus:
        """The last status of a motion to the goal, once it has succeeded. When cancelled, the robot is stopped.

        Args:
            goal: where to.
            more: as `plan` takes it.
            timeout: give up and stop after so long without progress, but for the time that the robot is held [s, wall].
            acknowledged: `newest` of the motion status as the operator requested this, for later motions of a sequence:
                newer interlocks of the same operator block it. Default: now.

        Raises:
            MotionFailed: a task has the robot, there is no way, or the motion ended otherwise.
            RequestFailed: planner or executor do not answer.
        """
        before = await self.require_free()
        response = await self.plan(goal, **more)
        if not response.ok or response.trajectory is None:
            raise MotionFailed(response.error, response.message)
        known = before.newest if acknowledged is None else acknowledged
        return await self._follow(response.trajectory, timeout, known, response)

    async def follow(
        self, trajectory: m.JointTrajectory, *, timeout: float = PATIENCE, plan: m.PlanResponse | None = None,
        acknowledged: int | None = None,
    ) -> m.MotionStatus:
        """The last status of following a trajectory that was planned before, by that plan; as `move` otherwise."""
        known = (await self.require_free()).newest if acknowledged is None else acknowledged
        return await self._follow(trajectory, timeout, known, plan)

    async def _follow(
        self, trajectory: m.JointTrajectory, timeout: float, acknowledged: int, plan: m.PlanResponse | None = None
    ) -> m.MotionStatus:
        """As `follow`; what was said later than `heard`, when the motion was asked for, keeps the robot."""
        if not isinstance(timeout, int | float) or not timeout > 0:
            raise ConfigError("timeout", timeout, "must be more than 0 [s]")
        if (await self.require_free()).held:  # with nothing under way, letting go moves nothing, nor does it later
            await self._hold.call(m.HoldRequest(hold=False, reason="a person moves the robot", owner=self._owner(),
                                                into_stop=True, acknowledged=acknowledged), REQUEST_TIMEOUT)
        request = m.ExecuteRequest(
            header=self._bus.header(), id=_mint(), trajectory=trajectory, owner=self._owner(),
            acknowledged=acknowledged, plan=plan.id if plan else "", scene_stamp=plan.scene_stamp if plan else 0)
        try:
            answer = await self._execute.call(request, REQUEST_TIMEOUT)
            if answer.state == "rejected":
                self._require_no_task()
                raise MotionFailed(answer.error, f"the motion was refused: {answer.message}")
            return await self._ended(answer, timeout)
        except (asyncio.CancelledError, Exception) as error:
            if not isinstance(error, MotionFailed) or isinstance(error, _Stalled):  # nobody waits for its end any more
                await self._bring_to_rest(request.id)
            raise

    async def require_free(self) -> m.MotionStatus:
        """The motion status, when nothing and nobody moves the robot.

        Raises:
            MotionFailed: a task or another person has it, somebody stops or holds it meanwhile, or nobody says how it
                is.
        """
        known, asked = self._motion.latest, wall_ns()
        status = await self._known()
        self._require_no_task()
        for interlock in status.interlocks:
            if interlock.by not in (self._owner(), m.UNKNOWN_OPERATOR, *OURSELVES):
                raise MotionFailed(interlock.kind, f"the robot is {interlock.description}")
        try:
            async with asyncio.timeout(COME_TO_REST):
                while status.state == "active":
                    status = await self._motion.next()
        except TimeoutError:
            raise MotionFailed("busy", f"the robot follows goal {status.id!r}: stop it first") from None
        # A program may move after a stop of its own.
        acknowledged = max(asked, known.newest if known else 0)
        for interlock in status.interlocks:
            if interlock.since > acknowledged and interlock.by not in OURSELVES:
                raise MotionFailed(interlock.kind, f"the robot is {interlock.description}")
        return status

    async def _known(self) -> m.MotionStatus:
        first = [asyncio.create_task(_first(reader)) for reader in self._tasks]
        try:
            if first:
                await asyncio.wait(first, timeout=FIRST_WORD, return_when=asyncio.FIRST_COMPLETED)
            async with asyncio.timeout(REQUEST_TIMEOUT):
                return await _first(self._motion)
        except TimeoutError:
            raise MotionFailed("no_state", "trajectory_executor does not say how the robot is") from None
        finally:
            for waiting in first:
                waiting.cancel()

    def _require_no_task(self) -> None:
        for reader in self._tasks:
            task = reader.latest
            if task is not None and task.paused:
                raise MotionFailed("task_paused", "the task is paused, its motion is only held: stop the task first")
            if task is not None and task.started and task.state not in AT_REST:
                raise MotionFailed("task_busy", f"the task is {task.state} and has the robot: stop the task first")

    async def _ended(self, accepted: m.MotionStatus, patience: float) -> m.MotionStatus:
        """The status of the goal that was accepted, once it has succeeded."""
        status: m.MotionStatus | None = accepted
        while True:
            if status is not None and status.id == accepted.id and status.state != "active":
                break
            if status is not None and status.id != accepted.id and status.header.stamp > accepted.header.stamp:
                raise MotionFailed("forgotten", "trajectory_executor was restarted and has forgotten the motion")
            try:
                async with asyncio.timeout(patience):
                    status = await self._motion.next()
            except TimeoutError:
                if status is None or not status.held:
                    raise _Stalled("timeout", f"no progress for {patience:g} s: the motion is given up") from None
                if not self._execute.available:  # whoever held it last may be gone, and the executor with them
                    raise RequestLost(self._execute.topic.key) from None
        if status.state != "succeeded":
            raise MotionFailed(status.error or status.state, f"the motion was {status.state}: {status.message}")
        return status

    async def _bring_to_rest(self, goal: str) -> None:
        try:
            gave_up = m.StopRequest(id=goal, reason="the person who asked for it gave up", by="requester")
            await self._stop.call(gave_up, REQUEST_TIMEOUT)
        except RequestFailed as error:
            log.warning("the robot may still move: %s", error)


class _Stalled(MotionFailed):
    """Nothing moves on, though nobody holds the robot."""


async def _first(reader: Reader[A]) -> A:
    """The newest message there is; the first to come when there is none yet."""
    return reader.latest or await reader.next()


def _mint() -> str:
    return f"operator-{new_id()}"
