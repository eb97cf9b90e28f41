"""Digital and analog inputs and outputs of a cell, for a program."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator

from common import topics
from common.client.arguments import require_seconds
from common.client.joining import newest_interlock
from common.client.subscriptions import NothingReceived, Part, Subscriptions
from common.config import Io, check
from common.errors import ConfigError, NoResponder, ZencellError
from common.messages import IoReply, IoSet, IoState
from common.tasks.signals import check_condition, condition_met, condition_text
from common.time_source import new_id

TIMEOUT = 5.0  # [s] wall for an answer
Value = bool | float


class SignalTimeout(ZencellError):
    """A signal did not have a value in time, or its backend was lost."""

    exit_code = 1


def signals_of(state: IoState) -> Io:
    """Return the signals of a state, to check names and values as the cell does."""
    return check(Io, {"backend": state.backend, "signals": {
        each.name: {each.direction: each.name, "unit": each.unit, "range": None if each.low is None else (
            each.low, each.high)} for each in state.signals}}, "io")


class Signals(Part):
    """Inputs and outputs by name. `async for state in cell.io` yields all of them after each change."""

    def __init__(self, subscriptions: Subscriptions, owner: str) -> None:
        """The signals of a cell; the client `owner` sets outputs."""
        self._subscriptions, self._bus, self._owner = subscriptions, subscriptions.bus, owner

    async def state(self) -> IoState:
        """Return all signals: value, time of the last change, and why one cannot be read.

        Raises:
            NoResponder: the cell has no I/O service.
        """
        try:
            return await self._subscriptions.query(topics.IO_STATE)
        except NothingReceived:
            raise NoResponder(f"{self._bus.cell}/{topics.IO_STATE.key}") from None

    async def read(self, name: str) -> Value:
        """Return the value of a signal: true or false, or a number in its unit.

        Raises:
            UnknownName: there is no such signal; with the choices.
            ZencellError: its value is not known, with the reason.
        """
        state = await self.state()
        signals_of(state).find(name)
        found = state.find(name)
        if (problem := state.problem(name)) or found is None or found.value is None:
            raise ZencellError(f"{name}: {problem}")
        return found.value

    async def set(self, name: str, value: Value = True) -> IoReply:
        """Set an output, and return its value after that.

        Raises:
            UnknownName: there is no such output; with the choices.
            ConfigError: the value has another type, or is out of range.
            RemoteError: the robot is stopped, another client has motion authority, or the backend is lost.
        """
        checked = signals_of(await self.state()).find(name, output=True).checked(name, value)
        acknowledged = await newest_interlock(self._bus)
        request = check(IoSet, {
            "header": self._bus.header(), "id": f"{self._owner}-{new_id()}"[-100:], "signal": name, "value": checked,
            "owner": self._owner, "acknowledged": acknowledged}, "io")
        return await self._bus.client(topics.IO_SET).call(request, TIMEOUT)

    async def wait(
        self, name: str, value: bool = True, timeout: float = 10.0, *, above: float | None = None,
        below: float | None = None,
    ) -> Value:
        """Wait until a signal has a value, and return it. A lost backend is waited for, too.

        Args:
            name: of the signal.
            value: of a digital signal.
            timeout: [s, wall].
            above: least value of an analog signal.
            below: largest value of an analog signal.

        Raises:
            UnknownName: there is no such signal; with the choices.
            ConfigError: a value does not fit the signal.
            SignalTimeout: it does not have the value in time.
        """
        require_seconds("timeout", timeout)
        reader = self._subscriptions.reader(topics.IO_STATE)  # no change after this state is missed
        state = await self.state()
        check_condition(name, signals_of(state).find(name).range is not None, above, below)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                while True:
                    found = state.find(name)
                    current = found.value if found is not None and not state.problem(name) else None
                    if current is not None and condition_met(current, value, above, below):
                        return current
                    newer = await reader.next()
                    state = newer if newer.header.stamp >= state.header.stamp else state
        why = f" ({problem})" if (problem := state.problem(name)) else ""
        raise SignalTimeout(f"{condition_text(name, value, above, below)} was not seen within {timeout:g} s{why}")

    async def __aiter__(self) -> AsyncGenerator[IoState, None]:
        reader = self._bus.reader(topics.IO_STATE)
        try:
            async for state in reader:
                yield state
        finally:
            self._bus.listen(reader, False)


def format_value(value: Value | None, unit: str = "") -> str:
    """Return a value as text: on, off, or a number with its unit."""
    if value is None:
        return "?"
    return ("on" if value else "off") if isinstance(value, bool) else f"{value:g} {unit}".rstrip()


def parse_value(name: str, text: str) -> Value:
    """Return the value of a text: on, off, true, false, or a number.

    Raises:
        ConfigError: it is none of these.
    """
    words = {"on": True, "true": True, "off": False, "false": False}
    if text.lower() in words:
        return words[text.lower()]
    try:
        return float(text)
    except ValueError:
        raise ConfigError(name, text, "must be on, off or a number") from None
