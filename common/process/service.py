"""The life that every service has: parse, connect, declare, be ready, run, and be gone within a second of a signal."""

from __future__ import annotations

import argparse
import asyncio
import gc
import logging
import os
import sys
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, NoReturn, Protocol, TypeVar

from common.clock import BOOTED_VARIABLE, EPOCH_VARIABLE, KEPT_VARIABLE, SPEED_VARIABLE, Clock
from common.config import Cell, Parameters, Watchdogs, load_cell, service_config
from common.errors import ConfigError, UnknownName, ZencellError
from common.process.environment import give_back, share_memory
from common.process.lifeline import Lifeline, fail, leave
from common.process.log import BusLog, log_to_stderr
from common.process.loop_watch import LoopWatch
from common.process.parameters import serve_parameters
from common.transport.bus import Bus
from common.transport.credentials import (
    PERIOD,
    CertificateMonitor,
    Credentials,
    common_name,
    credentials_of,
    secure_folder,
)
from common.transport.endpoint import endpoint_of
from common.transport.session import call_on_loop
from common.transport.zenoh_session import ZenohSession, close_within, open_zenoh

log = logging.getLogger(__name__)

P = TypeVar("P", bound=Parameters)
Run = Callable[[Bus, P], Coroutine[Any, Any, None]]

CELL_VARIABLE = "ZENCELL_CELL"
_CLOSE_SECONDS = 0.4
_PATIENCE_SECONDS = 2.0  # without a router before this is said
# A thread that computes gives the loop a turn this often: without it a message waits 5 ms for each turn.
_SWITCH_SECONDS = 0.0005
_GIVE_BACK_SECONDS = 20.0


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        fail(ConfigError(self.prog, message, "cannot be used; --help lists the options"))


@dataclass(frozen=True)
class Start(Generic[P]):
    """Everything that a service is started with."""

    name: str
    cell: str
    config: P
    clock: Clock
    endpoint: str
    watchdogs: Watchdogs
    credentials: Credentials | None = None
    topics: Mapping[str, str] = field(default_factory=dict)  # keys of the cell by its own words for them


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that every service process has."""
    parser.add_argument("--name", help="of this service in the cell, where that is not the name of its module")
    parser.add_argument("--cell", help=f"name or YAML file of the cell ({CELL_VARIABLE})")
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE",
        help="override a value of the cell; @FILE: those of a file",
    )
    parser.add_argument("--world", help="name or YAML file of another world")
    parser.add_argument("--seed", type=int, help="of everything random")
    parser.add_argument("--speed", type=float, help=f"of cell time, 0.1 to 10 ({SPEED_VARIABLE})")
    parser.add_argument("--domain", help="0 to 232 (ZENCELL_DOMAIN, 42)")
    parser.add_argument("--connect", metavar="ENDPOINT", help="router to use instead (ZENCELL_CONNECT)")
    add_process_options(parser)


def add_process_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that every process has, the router too."""
    parser.add_argument("--gate", action="store_true", help="wait for a line on stdin; its end ends the process")
    parser.add_argument("--log-json", action="store_true", help="log lines as JSON")


def clock_from(speed: float | None, environ: Mapping[str, str] = os.environ) -> Clock:
    """The clock that was handed down, at the given speed if there is one.

    Raises:
        ConfigError: speed or epoch cannot be used.
    """
    variables = dict(environ)
    if speed is not None:
        variables[SPEED_VARIABLE] = repr(speed)
    try:
        return Clock.from_environment(variables)
    except ValueError as error:
        names = (SPEED_VARIABLE, EPOCH_VARIABLE, BOOTED_VARIABLE, KEPT_VARIABLE)
        given = {name: variables[name] for name in names if name in variables}
        raise ConfigError("speed", given, f"cannot be used: {error}") from None


def prepare(kind: str, config: type[P], options: argparse.Namespace) -> Start[P]:
    """Resolve everything that a service is started with.

    Args:
        kind: the last part of its module, which is also its name if it is given no other.
        config: of that module.
        options: of the command line.

    Raises:
        ConfigError, UnknownName: one line that names the field, the value and the choices.
    """
    chosen = options.cell or os.environ.get(CELL_VARIABLE)
    if not chosen:
        raise ConfigError("--cell", "", f"must name a cell, also as {CELL_VARIABLE}")
    endpoint = endpoint_of(options.domain, options.connect)
    cell = load_cell(chosen, options.set, world=options.world, seed=options.seed)
    name = name_in(cell, kind, options.name)
    folder = secure_folder()
    credentials = credentials_of(common_name(cell.name, name), folder) if folder else None
    clock = clock_from(options.speed)
    topics = cell.services[name].topics if name in cell.services else {}
    return Start(
        name, cell.name, service_config(cell, name, config), clock, endpoint, cell.watchdogs, credentials, topics)


def name_in(cell: Cell, kind: str, given: str | None) -> str:
    """The name of a service in a cell; one that the cell does not have goes by its kind.

    Raises:
        ConfigError, UnknownName: the cell has none of that name and kind, or has it under other names only.
    """
    of_kind = [entry.name for entry in cell.services.values() if entry.kind == kind]
    if given is None:
        if kind not in cell.services and of_kind:
            raise ConfigError("--name", ..., f"is missing: in {cell.name} a {kind} is called {' or '.join(of_kind)}")
        given = kind
    elif given not in cell.services:
        raise UnknownName("--name", given, of_kind)
    if given in cell.services and given not in of_kind:
        raise ConfigError("--name", given, f"is a {cell.services[given].kind} in {cell.name}, not a {kind}")
    return given


def own_name() -> str:
    """Name of the module that was started with `python -m`."""
    main_module = sys.modules["__main__"]
    spec = getattr(main_module, "__spec__", None)
    if spec is not None:
        return str(spec.name).rpartition(".")[2]
    return Path(getattr(main_module, "__file__", None) or "service").stem


def main(run: Run[P], config: type[P]) -> NoReturn:
    """Be the service: `run(bus, config)` in a process of its own. Ends the process and does not return.

    Exit codes: 0 after SIGINT, SIGTERM, the end of the supervisor or of `run`; 2 for bad input, with one line on
    stderr; 1 for a crash, with its traceback.
    """
    sys.setswitchinterval(_SWITCH_SECONDS)
    share_memory()
    kind = own_name()
    parser = _Parser(prog=kind)
    add_options(parser)
    options = parser.parse_args()
    lifeline = Lifeline(gate=options.gate)
    lifeline.start()
    log_to_stderr(options.name or kind, as_json=options.log_json)
    try:
        start = prepare(kind, config, options)
    except ZencellError as error:
        fail(error)
    leave(run_until_stopped(lambda: _live(run, start, lifeline), lifeline))


def run_until_stopped(life: Callable[[], Coroutine[Any, Any, int]], lifeline: Lifeline) -> int:
    """The exit code of a coroutine that is cancelled when the lifeline says so.

    The loop is left as it is afterwards: asyncio's own end would wait for threads that still compute.
    """
    loop = asyncio.new_event_loop()
    task = loop.create_task(life())
    lifeline.on_stop(lambda: call_on_loop(loop, lambda: _drop(task)))
    try:
        return loop.run_until_complete(task)
    except asyncio.CancelledError:
        return 0 if lifeline.stopping else 1


def _drop(task: asyncio.Task[int]) -> None:
    task.cancel()


async def _live(run: Run[P], start: Start[P], lifeline: Lifeline) -> int:
    session = await _connected(start)
    try:
        await _gate(lifeline)
        bus = Bus(session, service=start.name, cell=start.cell, clock=start.clock, topics=start.topics)
        root = logging.getLogger()
        to_topic = BusLog(bus)
        root.addHandler(to_topic)
        ends = asyncio.create_task(_watch_end(bus, start.credentials))
        watch = LoopWatch(asyncio.get_running_loop(), lambda: _patience(start.watchdogs, bus.ready_event.is_set()))
        settling = asyncio.create_task(_settle(bus), name="settle")
        try:
            return await serve(run, bus, start.config, lifeline)
        finally:
            settling.cancel()
            watch.stop()
            ends.cancel()
            root.removeHandler(to_topic)
            await bus.close()
    finally:
        await close_within(session, _CLOSE_SECONDS)


async def _watch_end(bus: Bus, credentials: Credentials | None) -> None:
    """Log when the certificate of the process is about to end, as the page shows it."""
    if credentials is None:
        return
    watch = CertificateMonitor(credentials.certificate.parent, frozenset([credentials.certificate.stem]))
    await bus.ready_event.wait()
    while True:
        watch.log_new(bus.log)
        await asyncio.sleep(PERIOD)


async def _settle(bus: Bus) -> None:
    """Leave out of the garbage collector's looks what is there when the service is ready: modules, models.

    A whole look at them takes 50 ms, in which no set-point leaves. From then on memory that is free goes back now and
    then.
    """
    await bus.ready_event.wait()
    gc.freeze()
    while True:
        await asyncio.sleep(_GIVE_BACK_SECONDS)
        give_back()


def _patience(watchdogs: Watchdogs, ready: bool) -> float:
    """How long the loop may stand still [s]: while it starts, a service may load what it needs in one go."""
    return watchdogs.loop if ready or not watchdogs.loop else max(watchdogs.loop, watchdogs.start)


async def _connected(start: Start[P]) -> ZenohSession:
    opening = asyncio.ensure_future(open_zenoh(start.endpoint, start.credentials))
    try:
        done, _ = await asyncio.wait({opening}, timeout=_PATIENCE_SECONDS)
        if not done:
            log.warning("no router at %s yet, waiting for it", start.endpoint)
        return await opening
    finally:
        opening.cancel()


async def _gate(lifeline: Lifeline) -> None:
    if lifeline.gate_open.is_set():
        return
    opened = asyncio.Event()
    loop = asyncio.get_running_loop()
    lifeline.on_gate(lambda: call_on_loop(loop, opened.set))
    await opened.wait()


class Ending(Protocol):
    """Says whether and why a service was asked to end."""

    @property
    def stopping(self) -> bool:
        """Whether it was."""

    @property
    def reason(self) -> str:
        """Why."""


async def serve(run: Run[P], bus: Bus, config: P, lifeline: Ending) -> int:
    """Be the service on a bus; the exit code of its process."""
    try:
        bus.defer_writes()
        serve_parameters(bus, config)
        await bus.run(run(bus, config))
    except (ConfigError, UnknownName) as error:  # found only by using it: a description that is not there
        bus.log.error("%s", error)
        return 2
    except asyncio.CancelledError:
        if not lifeline.stopping:
            bus.log.error("run was cancelled from within")
            return 1
        bus.log.info("stopped: %s", lifeline.reason)
    except Exception:
        bus.log.exception("crashed")
        return 1
    return 0
