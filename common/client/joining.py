"""Joining a running cell from a tool or a script: its router, name, clock and services."""

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
PROBE_TIMEOUT, PROBE_PERIOD = 0.5, 0.1  # [s] to connect to the router's port, and between two attempts
TOKENS_TIMEOUT = 3.0  # [s] for readiness tokens: a busy host may stall for a second
QUERY_TIMEOUT = 1.0  # [s] for the value of a state


class NoCellRunning(RequestFailed):
    """No router or cell is running at an endpoint."""

    def __init__(self, endpoint: str, what: str) -> None:
        first = min(names_of("cells"), default="CELL")
        super().__init__(
            f"{what} at {endpoint}; is a cell up (`zencell up {first}`), and on this --domain or --connect?")
        self.endpoint = endpoint


class SeveralCellsRunning(UnknownName):
    """Several cells are running and none was named."""

    def __init__(self, cells: Iterable[str]) -> None:
        super().__init__("cell", "", cells)
        self.args = (f"several cells are up: name one, by Cell(NAME) or --cell NAME; choices: "
                     f"{', '.join(self.choices)}",)


def is_listening(endpoint: str) -> bool:
    """Return whether a program accepts connections at an endpoint; True for UDP and QUIC, which cannot be tested."""
    protocol, _, address = endpoint.partition("/")
    if protocol in ("udp", "quic"):
        return True
    host, _, port = address.split("?")[0].split("#")[0].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=PROBE_TIMEOUT):
            return True
    except (OSError, UnicodeError):  # the latter: an invalid host name
        return False


async def wait_for_listener(endpoint: str, seconds: float) -> None:
    """Return when a program accepts connections there; Zenoh's own attempts would outlive this program's end.

    Raises:
        NoCellRunning: none does within `seconds`.
    """
    try:
        async with asyncio.timeout(seconds):
            while not await asyncio.to_thread(is_listening, endpoint):  # noqa: ASYNC110 - there is no event for it
                await asyncio.sleep(PROBE_PERIOD)
    except TimeoutError:
        raise NoCellRunning(endpoint, "no router") from None


@contextlib.asynccontextmanager
async def joined(
    cell: str | None = None, *, domain: str | int | None = None, connect: str | None = None, any_cell: bool = False,
    identity: str = OPERATOR, remapped: Mapping[str, str] | None = None, secure: str | None = None,
) -> AsyncIterator[Bus]:
    """Yield a bus in a running cell.

    Args:
        cell: its name; default: the only running cell.
        domain: of its router, as for `--domain`.
        connect: endpoint of its router, as for `--connect`.
        any_cell: connect to the network; no cell needs to be running.
        identity: certificate to use in a secured cell.
        remapped: keys of the cell by the platform's names, like `topics:` of a service in a cell file.
        secure: folder of certificates; default: that of the environment.

    Raises:
        NoCellRunning: there is no router, or no cell.
        UnknownName: several cells are running and none was named.
        ConfigError: the name is not valid for a cell.
    """
    if cell is not None and not is_cell(cell):
        raise ConfigError("cell", cell, "is not a valid name of a cell")
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
                    cell = _only({name for name, _ in await ready_services(bus)}, endpoint)
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


async def ready_services(bus: Bus) -> list[tuple[str, str]]:
    """Return cell and name of every ready service on the network."""
    tokens = [token.split("/") for token in await bus.raw_tokens("*/alive/*", TOKENS_TIMEOUT)]
    return [(token[0], token[2]) for token in tokens]


@dataclass(frozen=True)
class RunningCell:
    """A running cell: its ready services, and the status of its supervisor, if it has one."""

    ready: frozenset[str]
    status: SupervisorStatus | None


async def running_cells(domain: str | None, connect: str | None) -> dict[str, RunningCell]:
    """Return the running cells by name; empty at once if no router is running.

    Args:
        domain: of the router, as for `--domain`.
        connect: endpoint of the router, as for `--connect`.
    """
    if not await asyncio.to_thread(is_listening, endpoint_of(domain, connect)):
        return {}
    ready: dict[str, set[str]] = {}
    try:
        async with joined(any_cell=True, domain=domain, connect=connect) as bus:
            for cell, service in await ready_services(bus):
                ready.setdefault(cell, set()).add(service)
            return {cell: RunningCell(frozenset(names), await supervisor_status(bus, cell))
                    for cell, names in ready.items()}
    except NoCellRunning:
        return {}


async def supervisor_status(bus: Bus, cell: str = "") -> SupervisorStatus | None:
    """Return the status of a cell's supervisor (default: this cell); None without one, as in containers.

    Each cell has at most one, and its key is never remapped.
    """
    for sample in await bus.raw_get(f"{cell or bus.cell}/{topics.SUPERVISOR_STATUS.key}", QUERY_TIMEOUT):
        try:
            return decode(SupervisorStatus, sample.payload)
        except DecodeError as error:
            bus.log.warning("%s: %s", sample.key, error)
    return None


async def cell_clock(bus: Bus) -> Clock:
    """Return the clock of the cell; without a supervisor, or if its clock is invalid, that of the environment."""
    status = await supervisor_status(bus)
    if status is None or not status.epoch:
        return bus.clock
    here = status.host == socket.gethostname()  # other hosts have another boot time
    try:
        clock = Clock(status.speed, status.epoch, status.booted if here and status.booted else None)
        if 0 <= clock.now_ns() <= MAX_STAMP:
            return clock
        problem = "its time is out of the range of stamps"
    except ValueError as error:
        problem = str(error)
    bus.log.warning("%s: its clock is ignored: %s", topics.SUPERVISOR_STATUS.key, problem)
    return bus.clock


async def newest_interlock(bus: Bus) -> int:
    """Return `since` of the newest interlock, 0 if unknown; a start releases no newer one."""
    newest = 0
    for sample in await bus.raw_get(bus.full_key(topics.MOTION_STATUS), QUERY_TIMEOUT):
        with contextlib.suppress(DecodeError):
            newest = max(newest, decode(MotionStatus, sample.payload).newest)
    return newest


def operator_name() -> str:
    """Return USER@HOST, the default name of an operator in requests, stops and holds."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in a container
        user = str(os.getuid()) if hasattr(os, "getuid") else "unknown"
    return "".join(filter(str.isprintable, f"{user}@{socket.gethostname()}"))[:120]
