"""Permission to move in a cell of several arms: the executor asks the coordinator before each motion.

A goal is accepted held at its start. The coordinator releases the hold once the motion is proved; without an answer
nothing moves.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Protocol

from common import topics
from common.clock import Clock
from common.errors import Refused, RequestFailed
from common.messages import ExecuteRequest, Header, ReserveReply, ReserveRequest
from common.time_source import monotonic
from common.transport.bus import Bus
from common.transport.requests import Client

CODE = "several_arms"  # of what the coordinator does not cover
UNANSWERED = 5.0  # [s] wall: a goal ends when the coordinator has not answered for so long
REPEAT = 0.25  # [s] cell time between requests
TIMEOUT = 1.0  # [s] wall, of an answer
ALONE = 0.5  # [s] wall: after the newest command an arm stops moving alone


class Goals(Protocol):
    """The executor as the reservation sees it."""

    @property
    def goal(self) -> str:
        """Id of the goal in progress."""

    def abort(self, error: str, message: str, source: str = "") -> None:
        """End it."""


class Reservation:
    """Asks the coordinator for one arm.

    Attributes:
        alone: why the arm may not move on an unknown path now; empty if it may.
    """

    def __init__(self, bus: Bus, arm: str) -> None:
        """Ask for the arm of this name."""
        self.arm = arm
        self._client: Client[ReserveRequest, ReserveReply] = bus.client(topics.RESERVE)
        self._clock: Clock = bus.clock
        self._log: logging.Logger = bus.log
        self._task: asyncio.Task[None] | None = None
        self._alone_task: asyncio.Task[None] | None = None
        self._wanted_alone = 0.0
        self.alone = "no permission of the coordinator yet"

    def check(self, request: ExecuteRequest) -> Refused | None:
        """Return why the coordinator does not cover a motion, or None."""
        if request.joins:
            return Refused(CODE, "in a cell of several arms a motion starts from rest: it cannot join another one")
        return None

    def ask_for(self, request: ExecuteRequest, arm: Goals, held: Callable[[], bool]) -> None:
        """Ask for an accepted goal while the coordinator holds it, at its start or on its path, until it is over."""
        if self._task is not None:
            self._task.cancel()
        reserve = ReserveRequest(
            arm=self.arm, id=request.id, trajectory=request.trajectory, may_touch=request.may_touch)
        self._task = asyncio.create_task(self._ask(reserve, arm, held), name="reservation")

    async def _ask(self, request: ReserveRequest, arm: Goals, held: Callable[[], bool]) -> None:
        answered = monotonic()
        while arm.goal == request.id:
            if not held():
                answered = monotonic()
                await asyncio.sleep(REPEAT / self._clock.speed)
                continue
            request.header = Header(stamp=self._clock.now_ns())
            try:
                reply = await self._client.call(request, TIMEOUT)
            except RequestFailed as error:
                if monotonic() - answered > UNANSWERED and arm.goal == request.id and held():
                    arm.abort("no_coordinator", f"no answer on arms/reserve for {UNANSWERED:g} s: {error}; a cell of "
                              "several arms needs the service arm_coordinator")
                    return
                await asyncio.sleep(REPEAT)
                continue
            answered = monotonic()
            if reply.state == "refused":
                if arm.goal == request.id and held():
                    arm.abort(reply.error, reply.message, "coordinator")
                return
            await asyncio.sleep(REPEAT / self._clock.speed)

    def check_alone(self) -> Refused | None:
        """Ask to move on an unknown path, and return why that is not granted yet; call it with each command."""
        self._wanted_alone = monotonic()
        if self._alone_task is None or self._alone_task.done():
            self._alone_task = asyncio.create_task(self._ask_alone(), name="reservation to move alone")
        return Refused(CODE, self.alone) if self.alone else None

    async def _ask_alone(self) -> None:
        request = ReserveRequest(arm=self.arm, id=f"{self.arm}-alone")
        while monotonic() - self._wanted_alone < ALONE:
            request.header = Header(stamp=self._clock.now_ns())
            try:
                reply = await self._client.call(request, TIMEOUT)
                self.alone = "" if reply.state == "granted" else f"the other arms come first: {reply.message}"
            except RequestFailed as error:
                self.alone = f"no permission of the coordinator: {error}"
            await asyncio.sleep(REPEAT / 2)
        self.alone = "no permission of the coordinator yet"

    def close(self) -> None:
        """Stop asking."""
        for task in (self._task, self._alone_task):
            if task is not None:
                task.cancel()
