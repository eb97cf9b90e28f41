"""Motions that an operator requests: planned from the current state, executed, awaited, jogged. Never against a task.

An operator may move the robot while no task uses it: the task was not started or was stopped, is idle, or has ended. A
task that has started must be stopped first, even if it is paused, because its motion is only held. If a task starts at
the same moment, the executor accepts one of the two, and the task waits for the end of the foreign motion.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from common import messages as m
from common import topics
from common.application import applications
from common.client.arguments import require_seconds
from common.client.subscriptions import Subscriptions
from common.config import check
from common.errors import RequestFailed, RequestLost, ZencellError
from common.time_source import new_id, wall_ns
from common.transport.bus import Bus
from common.transport.reader import Reader
from common.transport.requests import Client

log = logging.getLogger(__name__)

PLANNING_TIME = 5.0  # [s] wall
PLAN_OVERTIME = 15.0  # [s] wall for the answer beyond the planning time: requests of the task come first
REQUEST_TIMEOUT = 2.0  # [s] wall
PROGRESS_TIMEOUT = 10.0  # [s] wall without progress, holds not counted
STATUS_TIMEOUT = 0.5  # [s] wall in which an existing task status has arrived
REPEAT_PERIOD = 0.2  # [s] wall between requests of a force motion
BRAKING_TIMEOUT = 1.0  # [s] wall for a motion that is being stopped
AT_REST = ("IDLE", "DONE", "ERROR")  # states in which a task does not move the robot

JOG_PERIOD = 0.02  # [s] wall
LONGEST_JOG = 60.0  # [s] wall
AUTHORITY_TIMEOUT = 3.0  # [s] until jogging obtains motion authority
JOG_RETRY, JOG_PAUSE = 0.3, 0.4  # [s] of jogging without effect, and the pause after it before the next attempt
UNREACHABLE = "the arm cannot move in that direction, or its controller does not accept it in time"

A = TypeVar("A", bound=m.Message)

Goal = m.AnyGoal


class MotionFailed(ZencellError):
    """A motion that was rejected or did not succeed: `code` is for programs, the message for the operator."""

    exit_code = 1

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class OperatorMotion:
    """Moves the robot for an operator. A cell may have any number of these; the executor follows one goal at a time."""

    def __init__(
        self, bus: Bus, tasks: Sequence[Reader[Any]] | None = None, owner: str | Callable[[], str] = m.UNKNOWN_OPERATOR,
        status_timeout: float = STATUS_TIMEOUT,
    ) -> None:
        """Declare the requests and readers.

        Args:
            bus: in the cell.
            tasks: readers of the status of the cell's tasks (a `TaskStatus`); default: of all applications.
            owner: name of the operator, or a function that returns the current one. Their own stops and holds do not
                block their motions.
            status_timeout: in which an existing task status has arrived [s, wall].
        """
        self._owner = owner if callable(owner) else lambda: owner
        self._bus, self._status_timeout = bus, status_timeout
        self._plan, self._execute = bus.client(topics.MOTION_PLAN), bus.client(topics.MOTION_EXECUTE)
        self._stop, self._hold = bus.client(topics.MOTION_STOP), bus.client(topics.MOTION_HOLD)
        self._motion = bus.reader(topics.MOTION_STATUS)
        if tasks is None:
            tasks = [bus.reader(found.status) for found in applications()]
        self._tasks = tasks

    async def plan(self, goal: Goal, **more: Any) -> m.PlanResponse:
        """Return a trajectory from the current state, or what obstructs it; nothing moves.

        Args:
            goal: where to move.
            more: other fields of a `PlanRequest`, such as planner and straight.

        Raises:
            ConfigError: an unknown field, or an invalid value.
            RequestFailed: the planner does not answer, or does not know the scene or the robot's state yet.
        """
        fields = {"id": _new_goal_id(), "stage": "operator", "goal": goal, "planning_time": PLANNING_TIME, **more}
        request = check(m.PlanRequest, fields, "plan")
        return await self._plan.call(request, (request.planning_time or PLANNING_TIME) + PLAN_OVERTIME)

    async def move(
        self, goal: Goal, *, timeout: float = PROGRESS_TIMEOUT, acknowledged: int | None = None, **more: Any
    ) -> m.MotionStatus:
        """Move to a goal and return the last status of the motion. If cancelled, stop the robot.

        Args:
            goal: where to move.
            more: see `plan`.
            timeout: stop after this long without progress, not counting holds [s, wall].
            acknowledged: `newest` of the motion status when the operator requested this, for later motions of a
                sequence: newer interlocks of the same operator block it. Default: now.

        Raises:
            MotionFailed: a task has motion authority, there is no path, or the motion did not succeed.
            RequestFailed: planner or executor do not answer.
        """
        before = await self.require_free()
        response = await self.plan(goal, **more)
        if not response.ok or response.trajectory is None:
            raise MotionFailed(response.error, response.message)
        known = before.newest if acknowledged is None else acknowledged
        return await self._follow(response.trajectory, timeout, known, response)

    async def follow(
        self, trajectory: m.JointTrajectory, *, timeout: float = PROGRESS_TIMEOUT, plan: m.PlanResponse | None = None,
        acknowledged: int | None = None, force: Mapping[str, Any] | None = None,
    ) -> m.MotionStatus:
        """Follow a trajectory of an earlier plan; otherwise like `move`. With the fields of a force motion, do that."""
        known = (await self.require_free()).newest if acknowledged is None else acknowledged
        return await self._follow(trajectory, timeout, known, plan, force)

    async def _follow(
        self, trajectory: m.JointTrajectory, timeout: float, acknowledged: int, plan: m.PlanResponse | None = None,
        force: Mapping[str, Any] | None = None,
    ) -> m.MotionStatus:
        """Follow a trajectory; interlocks newer than `acknowledged` block it."""
        require_seconds("timeout", timeout)
        await self.release_holds(acknowledged)
        request = m.ExecuteRequest(
            header=self._bus.header(), id=_new_goal_id(), trajectory=trajectory, owner=self._owner(),
            acknowledged=acknowledged, plan=plan.id if plan else "", scene_stamp=plan.scene_stamp if plan else 0)
        repeating = None
        try:
            if force is None:
                answer = await self._execute.call(request, REQUEST_TIMEOUT)
            else:
                given = {name: getattr(request, name) for name in type(request).model_fields}
                request = check(m.ForceMotion, {**given, **force}, "force motion")
                client = self._bus.client(topics.MOTION_FORCE)
                answer = await client.call(request, REQUEST_TIMEOUT)
                repeating = asyncio.create_task(self._repeat(client, request), name="repeat force motion")
            if answer.state == "rejected":
                self._require_no_task()
                raise MotionFailed(answer.error, f"the motion was rejected: {answer.message}")
            return await self._ended(answer, timeout)
        except (asyncio.CancelledError, Exception) as error:
            if not isinstance(error, MotionFailed) or isinstance(error, _Stalled):  # the goal may still be active
                await self._stop_goal(request.id)
            raise
        finally:
            if repeating is not None:
                repeating.cancel()

    async def _repeat(self, client: Client[m.ForceMotion, m.MotionStatus], request: m.ForceMotion) -> None:
        """Repeat a force motion until cancelled: without that the executor ends it."""
        while True:
            await asyncio.sleep(REPEAT_PERIOD)
            with contextlib.suppress(RequestFailed):
                await client.call(request, REPEAT_PERIOD)

    async def release_holds(self, acknowledged: int) -> None:
        """Turn the operator's own holds, up to `acknowledged`, into stops, so that their next motion is not held.

        Raises:
            MotionFailed: as `require_free`.
            RequestFailed: the executor does not answer.
        """
        if (await self.require_free()).held:  # nothing is active: this release moves nothing, now or later
            await self._hold.call(m.HoldRequest(hold=False, reason="an operator moves the robot", owner=self._owner(),
                                                into_stop=True, acknowledged=acknowledged), REQUEST_TIMEOUT)

    async def require_free(self) -> m.MotionStatus:
        """Return the motion status if the robot is at standstill and no other operator blocks it.

        Raises:
            MotionFailed: another client has motion authority, the robot is stopped or held, or its state is unknown.
        """
        known, requested = self._motion.latest, wall_ns()
        status = await self._current_status()
        self._require_no_task()
        for interlock in status.interlocks:
            if interlock.blocks(self._owner()):
                raise MotionFailed(interlock.kind, f"the robot is {interlock.description}")
        try:
            async with asyncio.timeout(BRAKING_TIMEOUT):
                while status.state == "active":
                    status = await self._motion.next()
        except TimeoutError:
            raise MotionFailed("busy", f"the robot follows goal {status.id!r}: stop it first") from None
        # A program may move after a stop of its own.
        acknowledged = max(requested, known.newest if known else 0)
        for interlock in status.interlocks:
            if interlock.since > acknowledged and interlock.by not in m.SELF_RELEASING:
                raise MotionFailed(interlock.kind, f"the robot is {interlock.description}")
        return status

    async def _current_status(self) -> m.MotionStatus:
        first = [asyncio.create_task(_newest(reader)) for reader in self._tasks]
        try:
            if first:
                await asyncio.wait(first, timeout=self._status_timeout, return_when=asyncio.FIRST_COMPLETED)
            async with asyncio.timeout(REQUEST_TIMEOUT):
                return await _newest(self._motion)
        except TimeoutError:
            raise MotionFailed("no_state", "trajectory_executor publishes no motion status") from None
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

    async def _ended(self, accepted: m.MotionStatus, timeout: float) -> m.MotionStatus:
        """Return the last status of an accepted goal, once it has succeeded."""
        status: m.MotionStatus | None = accepted
        while True:
            if status is not None and status.id == accepted.id and status.state != "active":
                break
            if status is not None and status.id != accepted.id and status.header.stamp > accepted.header.stamp:
                raise MotionFailed("forgotten", "trajectory_executor was restarted and has forgotten the motion")
            try:
                async with asyncio.timeout(timeout):
                    status = await self._motion.next()
            except TimeoutError:
                if status is None or not status.held:
                    raise _Stalled("timeout", f"no progress for {timeout:g} s: the motion is stopped") from None
                if not self._execute.available:  # the executor may be gone, with its last status a hold
                    raise RequestLost(self._execute.topic.key) from None
        if status.state != "succeeded":
            raise MotionFailed(status.error or status.state, f"the motion was {status.state}: {status.message}")
        return status

    async def _stop_goal(self, goal: str) -> None:
        try:
            stop = m.StopRequest(id=goal, reason="its requester timed out", by="requester")
            await self._stop.call(stop, REQUEST_TIMEOUT)
        except RequestFailed as error:
            log.warning("the robot may still move: %s", error)


class _Stalled(MotionFailed):
    """A motion makes no progress although nothing holds the robot."""


async def _newest(reader: Reader[A]) -> A:
    """Return the newest message; wait for the first one."""
    return reader.latest or await reader.next()


def _new_goal_id() -> str:
    return f"operator-{new_id()}"


class JogFailed(ZencellError):
    """The arm was not jogged as requested."""

    exit_code = 1

    def __init__(self, owner: str, why: str) -> None:
        super().__init__(f"the arm is not jogged: the motion is {owner}{why and f'; {why}'}. See the executor's log: "
                         "zencell topic echo log/trajectory_executor")


class Jogging:
    """Sends a jog command at a steady rate, and checks that the executor obeys it."""

    def __init__(self, subscriptions: Subscriptions, command: m.JogCommand) -> None:
        """Prepare a command with its owner and velocities."""
        self._subscriptions, self._bus, self._command = subscriptions, subscriptions.bus, command
        self._motion = subscriptions.reader(topics.MOTION_STATUS)
        self._owners = subscriptions.reader(topics.MOTION_OWNER)
        self._writer = self._bus.writer(topics.MOTION_JOG)

    async def run(self, seconds: float) -> None:
        """Jog for a while [s], then send velocities of zero.

        Raises:
            JogFailed: motion authority was not obtained, or was lost.
            NothingReceived: the state of the robot is unknown.
        """
        acknowledged = (await self._subscriptions.latest(topics.MOTION_STATUS)).newest
        await self._subscriptions.latest(topics.MOTION_OWNER)
        clock = asyncio.get_running_loop().time
        first = began = clock()
        obeyed = False
        try:
            while (past := clock() - began) < seconds:
                self._writer.put(self._command.model_copy(
                    update={"header": self._bus.header(), "acknowledged": acknowledged}))
                await asyncio.sleep(JOG_PERIOD)
                waiting = not (self._obeys or obeyed or self._other_owner) and clock() - first < AUTHORITY_TIMEOUT
                if waiting and past > JOG_RETRY:  # an executor that just started, or refused us, needs a pause first
                    await asyncio.sleep(JOG_PAUSE)
                    began = clock()
                elif not self._obeys and not waiting:
                    late = obeyed and not self._owner.jogging
                    raise self._failure("commands of this program arrived too late" if late else UNREACHABLE)
                obeyed = obeyed or self._obeys
        finally:
            stop = m.JogCommand(header=self._bus.header(), owner=self._command.owner, acknowledged=acknowledged)
            self._writer.put(stop)
        while not obeyed and clock() - began < JOG_RETRY:  # the owner is published a moment after the command
            await asyncio.sleep(JOG_PERIOD)
            obeyed = self._obeys
        if not obeyed:
            raise self._failure(UNREACHABLE)

    @property
    def _owner(self) -> m.MotionOwner:
        owner = self._owners.latest
        assert owner is not None
        return owner

    @property
    def _obeys(self) -> bool:
        return self._owner.jogging and self._owner.owner == self._command.owner

    @property
    def _other_owner(self) -> bool:
        return self._owner.kind != "none" and self._owner.owner != self._command.owner

    def _failure(self, why: str) -> JogFailed:
        """Return the error, which names interlocks and another owner rather than the reason `why`."""
        status = self._motion.latest
        assert status is not None
        blocked = "; ".join(interlock.description for interlock in status.interlocks) or status.message
        return JogFailed(self._owner.description, blocked or ("" if self._other_owner else why))
