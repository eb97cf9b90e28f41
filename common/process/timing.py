"""Loops in time: a steady rate, requests that are retried until answered, devices that are reopened."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Container
from typing import NamedTuple, TypeVar

from pydantic import Field

from common.config import Parameters, Tunable
from common.errors import RemoteError, RequestFailed
from common.messages import Message
from common.transport.bus import Bus
from common.transport.requests import Client

A = TypeVar("A", bound=Message)
Q = TypeVar("Q", bound=Message)

NOT_READY_CODES = ("no_scene", "no_state", "no_points")  # the planner lacks messages that it needs to answer
# The server is busy or shuts down, or request or reply arrived damaged.
RETRY_CODES = (*NOT_READY_CODES, "busy", "internal", "invalid", "bad_answer")
RETRY_PERIOD = 0.1  # [s] wall
MOST_DOUBLINGS = 30  # of a wait, which has reached its limit long before


class LoopRate:
    """A loop rate on a fixed grid: a late turn causes neither drift nor a burst, missed turns are skipped.

    The rate is read again whenever parameters of the service change, also during a wait.

    Attributes:
        due: when the current turn was due, by the loop's clock [s].
    """

    def __init__(self, bus: Bus, rate: Callable[[], float]) -> None:
        """Start now; `rate` returns the turns per second of wall time [Hz]."""
        self._rate = rate
        self._loop = asyncio.get_running_loop()
        self.due = self._loop.time()
        self._changed = asyncio.Event()
        bus.on_parameters(self._changed.set)

    async def wait(self) -> None:
        """Return when the next turn is due."""
        while True:
            self._changed.clear()
            period = 1 / self._rate()
            following = self.due + period * max(1, math.ceil((self._loop.time() - self.due) / period))
            try:
                async with asyncio.timeout_at(following):
                    await self._changed.wait()
            except TimeoutError:
                self.due = following
                return


async def call_until_answered(
    client: Client[Q, A], request: Q, timeout: float, refused: Callable[[RemoteError], A],
    report: Callable[[str], None], again: Container[str] = NOT_READY_CODES,
) -> A:
    """Send a request again until it is answered. The id of the request makes that safe: no goal is executed twice.

    Args:
        client: of the request.
        request: with an id of its own.
        timeout: of each attempt [s, wall].
        refused: makes the answer from a refusal.
        report: receives the reason of each failed attempt.
        again: codes of refusals after which the request is sent again.
    """
    while True:
        try:
            return await client.call(request, timeout=timeout)
        except RemoteError as error:
            if error.code not in again:
                return refused(error)
            report(str(error))
        except RequestFailed as error:
            report(str(error))
        await asyncio.sleep(RETRY_PERIOD)


class Reopening(Parameters):
    """Waits before a lost device is opened again."""

    reopen_after: Tunable[float] = Field(
        0.5, gt=0, le=60, description="wait before a lost device is opened again, doubled after each failure [s]"
    )
    reopen_at_most: Tunable[float] = Field(10.0, gt=0, le=600, description="longest of these waits [s]")


class DeviceGone(NamedTuple):
    """A device that delivers nothing: the reason, and how many messages it delivered since it was opened."""

    why: str
    sent: int = 0


async def run_with_reopening(
    use: Callable[[], Awaitable[DeviceGone | None]], waits: Reopening, log: logging.Logger
) -> None:
    """Open and use a device until `use` returns None; after each loss log the reason, wait, and open it again.

    Args:
        use: opens the device and returns when it delivers nothing more; None at the end of its data.
        waits: read before each wait.
        log: receives the reason of each loss.
    """
    misses = 0  # in a row
    while (gone := await use()) is not None:
        misses = 0 if gone.sent else misses
        wait = min(waits.reopen_after * 2 ** min(misses, MOST_DOUBLINGS), waits.reopen_at_most)
        log.error("%s; opening it again in %g s", gone.why, wait)
        await asyncio.sleep(wait)
        misses += 1
