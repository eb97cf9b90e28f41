"""The seam to digital and analog inputs and outputs: what a module of drivers/io, or of a user, implements."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

from common.config import Io, Parameters, Signal, check
from common.config.io import Value
from common.errors import ConfigError
from common.messages import IoState
from common.plugins import find_plugin

GROUP, FIELD, MARKER = "zencell.io", "io.backend", "create_io"


class IoLost(Exception):
    """The backend does not answer: it has to be connected again."""


class Unreadable(NamedTuple):
    """Reason why one signal cannot be read, while others can."""

    reason: str


class IoConnection(Protocol):
    """Reads and writes signals by name. The caller limits the time of every call, and makes one at a time."""

    async def connect(self) -> None:
        """Connect, also again after a loss; write nothing.

        Raises:
            IoLost: with the reason.
        """

    async def read(self) -> Mapping[str, Value | Unreadable]:
        """Return all signals; of an output its present value.

        Raises:
            IoLost: with the reason.
        """

    async def write(self, name: str, value: Value) -> None:
        """Set an output.

        Raises:
            IoLost: with the reason.
            Refused: the backend is there but does not set it.
        """

    async def close(self) -> None:
        """Disconnect; outputs stay as they are."""


@runtime_checkable
class WorldSignals(IoConnection, Protocol):
    """Simulated signals, some of which the simulated world determines."""

    def expect(self, names: Iterable[str]) -> None:
        """Leave these signals unreadable until `sense` reports them."""

    def sense(self, state: IoState) -> None:
        """Take inputs of the simulated world; outputs only at first, as hardware keeps them over a restart."""


class IoBackend(Protocol):
    """A module of this group."""

    IoOptions: type[Parameters]

    def create_io(self, signals: Mapping[str, Signal], options: Any, now: Callable[[], float], /) -> IoConnection:
        """Create the connection without connecting; `now` returns cell time [s].

        Raises:
            ConfigError: a channel that the backend does not have, or a missing package.
        """


def load_io(io: Io, now: Callable[[], float]) -> IoConnection:
    """Create the connection of a cell's I/O; `now` returns cell time [s].

    Raises:
        UnknownName, ConfigError: no such backend, an invalid option or channel, or a missing package.
    """
    module = find_plugin(GROUP, io.backend, field=FIELD, noun="I/O backend", marker=MARKER)
    missing = [part for part in ("IoOptions", MARKER) if not hasattr(module, part)]
    if missing:
        raise ConfigError(FIELD, io.backend, f"is no I/O backend: it has no {', '.join(missing)}")
    backend = cast(IoBackend, module)
    return backend.create_io(io.signals, check(backend.IoOptions, io.options, "io.options"), now)


def channel_error(name: str, signal: Signal, expected: str) -> ConfigError:
    """Return the error of a channel that a backend does not have."""
    field = "output" if signal.is_output else "input"
    return ConfigError(f"io.signals.{name}.{field}", signal.channel, expected)
