"""Keeps the state of all signals, sets outputs on request, switches them at a STOP, and reconnects a lost backend."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import Protocol, TypeVar

from common.clock import Clock
from common.config import Io
from common.config.io import Value
from common.control.interlocks import Interlocks, Record
from common.control.motion_authority import MotionOwnership, check_age
from common.errors import ConfigError, Refused, UnknownName
from common.hardware.signals import IoConnection, IoLost, Unreadable
from common.messages import Header, IoReply, IoSet, IoSignal, IoState, MotionOwner, MotionStatus

T = TypeVar("T")

LOST = "io_lost"  # code of a refusal: the backend does not answer
NOT_CONNECTED = "not connected yet"
NOISE_SHARE = 0.02  # of the range of an analog signal, by which good values may leave it


class Waits(Protocol):
    """Times of the service [s, wall]; read at each use."""

    answer_timeout: float
    request_timeout: float
    clock_tolerance: float
    reopen_after: float
    reopen_at_most: float


class SignalServer:
    """The signals of a cell over one connection. Outputs are written on request and at a STOP, never otherwise."""

    def __init__(
        self, io: Io, connection: IoConnection, waits: Waits, clock: Clock, log: logging.Logger,
        publish: Callable[[IoState], None],
    ) -> None:
        """Start disconnected, with unknown values."""
        self._io, self._connection, self._waits, self._clock, self._log = io, connection, waits, clock, log
        self._publish = publish
        self._lock = asyncio.Lock()  # one call of the connection at a time
        self._woken = asyncio.Event()
        self._lost: IoLost | None = None  # by a request; the loop connects again
        self._motion: MotionStatus | None = None
        self._owner = MotionOwner()
        self._switched = 0  # `since` of the newest stop for which outputs were switched
        limits = {name: signal.range or (None, None) for name, signal in io.signals.items()}
        self.state = IoState(backend=io.backend, reason=NOT_CONNECTED, signals=[
            IoSignal(name=name, direction="output" if signal.is_output else "input", unit=signal.unit,
                     low=limits[name][0], high=limits[name][1]) for name, signal in io.signals.items()])

    # --- what the robot does ---------------------------------------------------------------------------------------

    def set_motion(self, motion: MotionStatus) -> None:
        """Take the newest motion status; a new stop switches outputs at once."""
        self._motion = motion
        if self._stop_to_handle():
            self._woken.set()

    def set_owner(self, owner: MotionOwner) -> None:
        """Take the current owner of the motion."""
        self._owner = owner

    def _stop_to_handle(self) -> int:
        """Return `since` of the newest stop, if outputs have to be switched for it; else 0."""
        stops = [one.since for one in self._motion.interlocks if one.kind == "stopped"] if self._motion else []
        newest = max(stops, default=0)
        return newest if newest > self._switched else 0

    # --- the loop --------------------------------------------------------------------------------------------------

    async def run(self, period: Callable[[], float]) -> None:
        """Read all signals every `period` of wall time [s] until cancelled; connect again after each loss."""
        misses = 0
        try:
            while True:
                try:
                    async with self._lock:
                        self._lost = None
                        await self._in_time(self._connection.connect())
                        await self._read()
                    if misses:
                        self._log.info("%s answers again", self._io.backend)
                    misses = 0
                    await self._exchange(period)
                except IoLost as lost:
                    if not misses:
                        self._log.error("%s: %s; connecting again", self._io.backend, lost)
                    self._put(reason=str(lost))
                with contextlib.suppress(IoLost):
                    await self._in_time(self._connection.close())
                wait = min(self._waits.reopen_after * 2 ** min(misses, 30), self._waits.reopen_at_most)
                misses += 1
                await asyncio.sleep(wait)
        finally:
            await self._connection.close()

    async def _exchange(self, period: Callable[[], float]) -> None:
        """Read in turns until the backend is lost."""
        while True:
            self._woken.clear()
            async with self._lock:
                if self._lost is not None:
                    raise self._lost
                await self._switch_outputs()
                await self._read()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(period()):
                    await self._woken.wait()

    async def _switch_outputs(self) -> None:
        """Switch outputs with `on_stop: off` off after a new stop; one that is refused is tried again next turn."""
        if not (stop := self._stop_to_handle()):
            return
        done = True
        for name, signal in self._io.signals.items():
            known = self.state.find(name)
            if signal.on_stop != "off" or known is None or known.value == signal.off:
                continue
            try:
                await self._in_time(self._connection.write(name, signal.off))
                self._log.info("%s: off, because the robot is stopped", name)
            except Refused as refusal:
                done = False
                self._log.error("%s cannot be switched off after a stop: %s", name, refusal)
        self._switched = stop if done else self._switched

    async def _read(self) -> None:
        self._note(await self._in_time(self._connection.read()))

    async def _in_time(self, call: Awaitable[T]) -> T:
        """Return the result of a call of the connection.

        Raises:
            IoLost: it takes too long.
        """
        longest = self._waits.answer_timeout
        try:
            async with asyncio.timeout(longest):
                return await call
        except TimeoutError:
            raise IoLost(f"no answer within {longest:g} s") from None

    def _note(self, values: Mapping[str, Value | Unreadable]) -> None:
        """Publish what was read, if it has changed."""
        now, signals = self._clock.now_ns(), []
        for signal in self.state.signals:
            value = values.get(signal.name, Unreadable("not read"))
            value = _out_of_range(signal, value) or value
            if isinstance(value, Unreadable):
                update: dict[str, object] = {"reason": value.reason}
            else:
                changed = signal.value is None or value != signal.value
                update = {"value": value, "reason": "", "stamp": now if changed else signal.stamp}
            signals.append(signal.model_copy(update=update))
        self._put(reason="", signals=signals)

    def _put(self, **update: object) -> None:
        changed = self.state.model_copy(update=update)
        if changed != self.state:
            self.state = changed.model_copy(update={"header": Header(stamp=self._clock.now_ns())})
            self._publish(self.state)

    # --- requests --------------------------------------------------------------------------------------------------

    async def set(self, request: IoSet) -> IoReply:
        """Set an output, and return its value as it is read after that.

        Raises:
            Refused: it is no output, the value is out of range, the robot is stopped or has another owner, the
                request is too old, or the backend is lost.
        """
        try:
            value = self._io.find(request.signal, output=True).checked(request.signal, request.value)
        except (UnknownName, ConfigError) as error:
            code = "unknown_output" if isinstance(error, UnknownName) else "bad_value"
            raise Refused(code, str(error)) from None
        async with self._lock:
            if (refusal := self._check(request)) is not None:
                raise refusal
            if self.state.reason or self._lost is not None:
                raise Refused(LOST, f"{self._io.backend}: {self._lost or self.state.reason}")
            try:
                await self._in_time(self._connection.write(request.signal, value))
                await self._read()
            except IoLost as lost:
                self._lost = lost
                self._woken.set()
                self._put(reason=str(lost))
                raise Refused(LOST, f"{self._io.backend}: {lost}; {request.signal} may have been set") from None
        self._log.log(logging.INFO if request.owner else logging.DEBUG, "%s: %s by %s", request.signal, value,
                      request.owner or "the task")
        known = self.state.find(request.signal)
        return IoReply(header=Header(stamp=self._clock.now_ns()), id=request.id, signal=request.signal,
                       value=known.value if known else None)

    def _check(self, request: IoSet) -> Refused | None:
        """Return why an output must not be set now, by the rules of motion, or None."""
        if self._motion is None:
            return Refused("no_state", "no motion status received yet")
        stops = [one for one in self._motion.interlocks if one.kind == "stopped"]
        interlocks, ownership = Interlocks(Record(interlocks=stops, newest=self._motion.newest)), MotionOwnership()
        ownership.now = self._owner
        age = self._clock.age_ms(request.header.stamp) * 1e-3
        stale = check_age(age, self._waits.request_timeout, self._waits.clock_tolerance)
        return (interlocks.check("", request.owner, request.acknowledged)
                or (stale if request.header.stamp else None) or ownership.check(request.owner))


def _out_of_range(signal: IoSignal, value: Value | Unreadable) -> Unreadable | None:
    """Return the reason why an analog value is not good: a broken wire or a wrong scale, beyond noise."""
    if signal.low is None or signal.high is None or not isinstance(value, int | float):
        return None
    noise = NOISE_SHARE * (signal.high - signal.low)
    if signal.low - noise <= value <= signal.high + noise:
        return None
    return Unreadable(f"{value:g} is not within {signal.low:g} to {signal.high:g} {signal.unit}".rstrip())
