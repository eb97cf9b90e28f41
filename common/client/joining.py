"""Join a running cell from a tool or a script, or start one in processes of its own and end it."""

from __future__ import annotations

import asyncio
import contextlib
import getpass
import os
import random
import signal
import socket
import subprocess
import tempfile
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from common import topics
from common.arms import arms_topic
from common.client.several_arms import arm_names
from common.clock import Clock
from common.config import default_cell, load_cell, names_of
from common.errors import ConfigError, DecodeError, NoRouter, RequestFailed, UnknownName, ZencellError
from common.messages import MotionStatus, SupervisorStatus
from common.messages.basics import MAX_STAMP
from common.remapping import is_cell
from common.supervision.launch import module_command, pythonpath, require_free_port
from common.transport.bus import Bus
from common.transport.codec import decode
from common.transport.credentials import OPERATOR, SECURE_VARIABLE
from common.transport.endpoint import CONNECT_VARIABLE, DOMAIN_VARIABLE, MAX_DOMAIN, endpoint_of, parse_domain
from common.transport.router import PortInUse
from common.transport.zenoh_session import connect as connect_to

TOOL = "zencell"
CONNECT_TIMEOUT = 2.0  # [s] to reach the router
PROBE_TIMEOUT, PROBE_PERIOD = 0.5, 0.1  # [s] to connect to the router's port, and between two attempts
TOKENS_TIMEOUT = 3.0  # [s] for readiness tokens: a busy host may stall for a second
CELL_PROBES = 10  # for the first service of a cell
QUERY_TIMEOUT = 1.0  # [s] for the value of a state


class NoCellRunning(RequestFailed):
    """No router or cell is running at an endpoint."""

    def __init__(self, endpoint: str, what: str) -> None:
        first = default_cell() if names_of("cells") else "CELL"
        super().__init__(
            f"{what} at {endpoint}; is a cell up (`zencell up {first}`), and on this --domain or --connect?")
        self.endpoint = endpoint


class SeveralCellsRunning(UnknownName):
    """Several cells are running and none was named."""

    def __init__(self, cells: Iterable[str], how: str = "by Cell(NAME) or --cell NAME") -> None:
        super().__init__("cell", "", cells)
        self.args = (f"several cells are up: name one, {how}; choices: {', '.join(self.choices)}",)


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
                    cell = _only(await _ready_cells(bus), endpoint)
            bus = await stack.enter_async_context(connect_to(
                cell=cell or "_", service=TOOL, endpoint=endpoint, clock=Clock.from_environment(),
                timeout=CONNECT_TIMEOUT, identity=identity, remapped=remapped,
                secure=secure))
            yield bus
    except NoRouter:
        raise NoCellRunning(endpoint, "no router") from None


async def domain_of_only(cell: str | None, secure: str | None) -> int | None:
    """Return the domain of this host with the only running cell, if the default domain has no router.

    Args:
        cell: its name; default: any.
        secure: folder of certificates; default: that of the environment.

    Raises:
        SeveralCellsRunning: several are running; names their domains.
    """
    environ = {**os.environ, SECURE_VARIABLE: secure} if secure else os.environ
    chosen = bool({DOMAIN_VARIABLE, CONNECT_VARIABLE} & environ.keys())
    if chosen or await asyncio.to_thread(is_listening, endpoint_of(environ=environ)):
        return None

    def listening() -> list[int]:
        return [number for number in range(MAX_DOMAIN + 1) if is_listening(endpoint_of(number, environ=environ))]

    async def cells_in(domain: int) -> set[tuple[str, int]]:
        with contextlib.suppress(RequestFailed):
            async with joined(any_cell=True, domain=domain, secure=secure) as bus:
                return {(name, domain) for name, _ in await ready_services(bus)}
        return set()

    domains_up = await asyncio.to_thread(listening)
    found = [pair for pairs in await asyncio.gather(*map(cells_in, domains_up)) for pair in sorted(pairs)]
    domains = {domain: name for name, domain in found if cell in (None, name)}
    if len(domains) > 1:
        raise SeveralCellsRunning((f"{name} in domain {domain}" for domain, name in domains.items()), "by domain=")
    return next(iter(domains), None)


def _only(cells: set[str], endpoint: str) -> str:
    if not cells:
        raise NoCellRunning(endpoint, "there is a router and no service")
    if len(cells) > 1:
        raise SeveralCellsRunning(cells)
    return cells.pop()


async def _ready_cells(bus: Bus) -> set[str]:
    """Return the cells with a ready service, as soon as there is one: a busy router may be late."""
    for _ in range(CELL_PROBES):
        if found := {cell for cell, _ in await ready_services(bus)}:
            return found
        await asyncio.sleep(PROBE_PERIOD)
    return set()


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
    """Return `since` of the newest interlock, of all arms of a cell; 0 if unknown; a start releases no newer one."""
    samples = await bus.raw_get(bus.full_key(topics.MOTION_STATUS), QUERY_TIMEOUT)
    if not samples:
        for arm in await arm_names(bus):
            samples += await bus.raw_get(bus.full_key(arms_topic(topics.MOTION_STATUS, arm)), QUERY_TIMEOUT)
    newest = 0
    for sample in samples:
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


START_TIMEOUT = 60.0  # [s] wall
POLL_PERIOD = 0.1  # [s] between two checks of its state
END_TIMEOUT = 15.0  # [s] after which it is killed
ATTEMPTS, IN_USE = 3, "is in use by"  # domains to try; text in the output of `up` about a domain in use
LAST_LINES = 5  # of the output, in the error of a failed start


class NotStarted(ZencellError):
    """The cell did not come up."""

    exit_code = 1

    def __init__(self, cell: str, why: str) -> None:
        super().__init__(f"{cell} did not come up: {why}")


class StartedCell:
    """A cell that runs inside `async with`, with its `name` and `domain`."""

    def __init__(
        self, cell: str, *, speed: float, world: str | None, seed: int | None, overrides: Sequence[str], viewer: bool,
        domain: int | str | None,
    ) -> None:
        """Describe the cell to start; see `Cell.start`."""
        self._domain = domain
        self.name, self.domain = "", -1
        self._arguments = ["up", cell, "--until-stdin-ends", "--speed", f"{speed:g}"]
        self._arguments += [] if viewer else ["--no-viewer"]
        self._arguments += [] if world is None else ["--world", world]
        self._arguments += [] if seed is None else ["--seed", str(seed)]
        self._arguments += [part for value in overrides for part in ("--set", value)]
        self._loaded = (cell, tuple(overrides), world, seed)
        self._process: subprocess.Popen[bytes] | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._log = Path()

    async def __aenter__(self) -> StartedCell:
        cell, overrides, world, seed = self._loaded
        loaded = await asyncio.to_thread(load_cell, cell, overrides, world=world, seed=seed)  # raises on bad input
        self.name = loaded.name
        for left in reversed(range(ATTEMPTS)):
            self.domain = free_domain() if self._domain is None else parse_domain(self._domain)
            try:
                return await self._bring_up()
            except NotStarted as error:  # another program may have taken the same free domain
                if IN_USE not in str(error) or self._domain is not None or not left:
                    raise
        raise AssertionError

    async def _bring_up(self) -> StartedCell:
        self._folder = tempfile.TemporaryDirectory(prefix="zencell-")
        self._log = Path(self._folder.name, "log")
        self._process = await asyncio.to_thread(self._spawn)
        try:
            async with asyncio.timeout(START_TIMEOUT):
                await self._until_up()
        except BaseException as error:
            output = self._last_lines()
            await self._end()
            if isinstance(error, TimeoutError):
                raise NotStarted(self.name, f"not within {START_TIMEOUT:g} s; {output}") from None
            raise
        return self

    def _spawn(self) -> subprocess.Popen[bytes]:
        with self._log.open("wb") as out:
            return subprocess.Popen(
                [*module_command("zencell"), *self._arguments, "--domain", str(self.domain)],
                stdin=subprocess.PIPE, stdout=out, stderr=subprocess.STDOUT, start_new_session=True,
                env={**os.environ, "PYTHONPATH": pythonpath()})

    async def _until_up(self) -> None:
        """Return when all services are ready.

        Raises:
            NotStarted: the process has ended instead.
        """
        while not await self._is_up():
            assert self._process is not None
            if self._process.poll() is not None:
                raise NotStarted(self.name, self._last_lines())
            await asyncio.sleep(POLL_PERIOD)

    async def _is_up(self) -> bool:
        if not await asyncio.to_thread(is_listening, endpoint_of(self.domain)):
            return False
        try:
            async with joined(self.name, domain=self.domain) as bus:
                status = await supervisor_status(bus)
        except RequestFailed:
            return False
        return status is not None and all(service.state == "ready" for service in status.services)

    def _last_lines(self) -> str:
        lines = [line for line in self._log.read_text(errors="replace").splitlines() if line.strip()]
        return " | ".join(lines[-LAST_LINES:]) or "it wrote nothing"

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        process, folder = self._process, self._folder
        self._process = self._folder = None
        if process is not None:
            await asyncio.shield(_end_process(process))
        if folder is not None:
            folder.cleanup()


async def _end_process(process: subprocess.Popen[bytes]) -> None:
    """End a process without a thread: none can be started while the interpreter exits."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    if process.stdin is not None:
        process.stdin.close()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(END_TIMEOUT):
            while process.poll() is None:  # noqa: ASYNC110 - there is no event for it
                await asyncio.sleep(POLL_PERIOD / 2)
    if process.poll() is None:
        process.kill()
        process.wait()


def free_domain() -> int:
    """Return a random domain whose port is free.

    Raises:
        NotStarted: all are in use.
    """
    for domain in random.SystemRandom().sample(range(MAX_DOMAIN + 1), MAX_DOMAIN + 1):
        try:
            require_free_port(endpoint_of(domain))
        except PortInUse:
            continue
        return domain
    raise NotStarted("the cell", "all domains are in use")
