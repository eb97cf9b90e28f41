"""Taking part in a cell that is up, from a tool or a script: finding it, its clock, and who is there."""

from __future__ import annotations

import asyncio
import contextlib
import getpass
import os
import socket
from collections.abc import AsyncIterator, Iterable, Mapping
from dataclasses import dataclass

from common import topics
from common.clock import Clock
from common.config import names_of
from common.errors import ConfigError, DecodeError, NoRouter, RequestFailed, UnknownName
from common.messages import MotionStatus, SupervisorStatus
from common.messages.basics import MAX_STAMP
from common.remapping import is_cell
from common.transport.bus import Bus
from common.transport.codec import decode
from common.transport.credentials import OPERATOR, SECURE_VARIABLE
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect as connect_to

TOOL = "zencell"
CONNECT_TIMEOUT = 2.0  # [s] to reach the router
PROBE_TIMEOUT, PROBE_PERIOD = 0.5, 0.1  # [s] to see whether anything listens where a router would; between two tries
LOOK_TIMEOUT = 3.0  # [s] to hear who is there: a busy host stands still for a second
ASK_TIMEOUT = 1.0  # [s]


class NoCellRunning(RequestFailed):
    """There is no cell to look at."""

    def __init__(self, endpoint: str, what: str) -> None:
        first = min(names_of("cells"), default="CELL")
        super().__init__(
            f"{what} at {endpoint}; is a cell up (`zencell up {first}`), and on this --domain or --connect?")
        self.endpoint = endpoint


class SeveralCellsRunning(UnknownName):
    """It is not clear which cell is meant."""

    def __init__(self, cells: Iterable[str]) -> None:
        super().__init__("cell", "", cells)
        self.args = (f"several cells are up: name one, by Cell(NAME) or --cell NAME; choices: "
                     f"{', '.join(self.choices)}",)


def is_listening(endpoint: str) -> bool:
    """Whether something takes connections at an endpoint; True where that cannot be told without Zenoh."""
    protocol, _, address = endpoint.partition("/")
    if protocol in ("udp", "quic"):
        return True
    host, _, port = address.split("?")[0].split("#")[0].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=PROBE_TIMEOUT):
            return True
    except (OSError, UnicodeError):  # the latter: a name that no host can have
        return False


async def wait_for_listener(endpoint: str, seconds: float) -> None:
    """Return when something takes connections there: what Zenoh tries meanwhile would go on after this program's end.

    Raises:
        NoCellRunning: nothing does.
    """
    try:
        async with asyncio.timeout(seconds):
            while not await asyncio.to_thread(is_listening, endpoint):  # noqa: ASYNC110 - nothing tells of it
                await asyncio.sleep(PROBE_PERIOD)
    except TimeoutError:
        raise NoCellRunning(endpoint, "no router") from None


@contextlib.asynccontextmanager
async def joined(
    cell: str | None = None, *, domain: str | int | None = None, connect: str | None = None, any_cell: bool = False,
    identity: str = OPERATOR, remapped: Mapping[str, str] | None = None, secure: str | None = None,
) -> AsyncIterator[Bus]:
    """A bus in a cell that is up.

    Args:
        cell: its name; when not given, the one cell that is up.
        domain: where, as given to `--domain`.
        connect: where, as given to `--connect`.
        any_cell: the visit is to the network, no cell needs to be up.
        identity: whose certificate is shown in a secured cell.
        remapped: keys of the cell by the platform's words for them, as `topics:` of a service in a cell file.
        secure: folder of certificates; that of the environment when not given.

    Raises:
        NoCellRunning: there is no router, or no cell.
        UnknownName: several cells are up and none was named.
        ConfigError: no cell can have that name.
    """
    if cell is not None and not is_cell(cell):
        raise ConfigError("cell", cell, "is no name that a cell can have")
    environ = {**os.environ, SECURE_VARIABLE: secure} if secure else os.environ
    endpoint = endpoint_of(domain, connect, environ)
    await wait_for_listener(endpoint, CONNECT_TIMEOUT)
    try:
        async with contextlib.AsyncExitStack() as stack:
            if cell is None and not any_cell:
                async with connect_to(
                    cell="_", service=TOOL, endpoint=endpoint, timeout=CONNECT_TIMEOUT, identity=identity,
                    secure=secure,
                ) as bus:
                    cell = _only({name for name, _ in await alive(bus)}, endpoint)
            bus = await stack.enter_async_context(connect_to(
                cell=cell or "_", service=TOOL, endpoint=endpoint, clock=Clock.from_environment(),
                timeout=CONNECT_TIMEOUT, identity=identity, remapped=remapped,
                secure=secure))
            yield bus
    except NoRouter:
        raise NoCellRunning(endpoint, "no router") from None


def _only(cells: set[str], endpoint: str) -> str:
    if not cells:
        raise NoCellRunning(endpoint, "there is a router and no service")
    if len(cells) > 1:
        raise SeveralCellsRunning(cells)
    return cells.pop()


async def alive(bus: Bus) -> list[tuple[str, str]]:
    """Cell and name of every service on the network that is ready."""
    tokens = [token.split("/") for token in await bus.raw_tokens("*/alive/*", LOOK_TIMEOUT)]
    return [(token[0], token[2]) for token in tokens]


@dataclass(frozen=True)
class RunningCell:
    """What there is of a cell that is up."""

    ready: frozenset[str]  # services
    status: SupervisorStatus | None  # what its supervisor says, where there is one


async def look(domain: str | None, connect: str | None) -> dict[str, RunningCell]:
    """The cells that are up, by name; none when nothing is up there, for which nobody is waited for.

    Args:
        domain: where, as given to `--domain`.
        connect: where, as given to `--connect`.
    """
    if not await asyncio.to_thread(is_listening, endpoint_of(domain, connect)):
        return {}
    ready: dict[str, set[str]] = {}
    try:
        async with joined(any_cell=True, domain=domain, connect=connect) as bus:
            for cell, service in await alive(bus):
                ready.setdefault(cell, set()).add(service)
            return {cell: RunningCell(frozenset(names), await supervisor_status(bus, cell))
                    for cell, names in ready.items()}
    except NoCellRunning:
        return {}


async def supervisor_status(bus: Bus, cell: str = "") -> SupervisorStatus | None:
    """What the supervisor of a cell, or of this one, says now; None without one, as in containers.

    There is one in a cell, whose key nobody renames.
    """
    for sample in await bus.raw_get(f"{cell or bus.cell}/{topics.SUPERVISOR_STATUS.key}", ASK_TIMEOUT):
        try:
            return decode(SupervisorStatus, sample.payload)
        except DecodeError as error:
            bus.log.warning("%s: %s", sample.key, error)
    return None


async def cell_clock(bus: Bus) -> Clock:
    """The clock that the cell runs by; the environment's where no supervisor tells, or of none that there can be."""
    status = await supervisor_status(bus)
    if status is None or not status.epoch:
        return bus.clock
    here = status.host == socket.gethostname()  # another host has a clock of its own
    try:
        clock = Clock(status.speed, status.epoch, status.booted if here and status.booted else None)
        if 0 <= clock.now_ns() <= MAX_STAMP:
            return clock
        told = "its time is none that a stamp can say"
    except ValueError as error:
        told = str(error)
    bus.log.warning("%s: the clock that it tells of is left out: %s", topics.SUPERVISOR_STATUS.key, told)
    return bus.clock


async def newest_interlock(bus: Bus) -> int:
    """`since` of the newest stop or hold that can be known now: a start lets go of nothing later, 0 of nothing."""
    newest = 0
    for sample in await bus.raw_get(bus.full_key(topics.MOTION_STATUS), ASK_TIMEOUT):
        with contextlib.suppress(DecodeError):
            newest = max(newest, decode(MotionStatus, sample.payload).newest)
    return newest


def person() -> str:
    """Who gives a command here: what a cell remembers of who stopped or holds a robot."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in a container
        user = str(os.getuid()) if hasattr(os, "getuid") else "somebody"
    return "".join(filter(str.isprintable, f"{user}@{socket.gethostname()}"))[:120]
