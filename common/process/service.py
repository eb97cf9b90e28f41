"""The life of every service: parse options, connect, declare, report ready, run, exit within a second of a signal."""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import logging
import os
import sys
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, NoReturn, Protocol, TypeVar

from common import topics
from common.clock import BOOTED_VARIABLE, CLOCK_FOLDER_VARIABLE, EPOCH_VARIABLE, SPEED_VARIABLE, Clock
from common.config import OVERRIDES_VARIABLE, Cell, Parameters, Watchdogs, load_cell, located, service_config
from common.config.tunables import apply, checked, describe, values_of
from common.errors import ConfigError, UnknownName, ZencellError
from common.messages import ParameterReply, ParameterRequest
from common.process.environment import release_free_memory, use_single_memory_arena
from common.process.lifeline import Lifeline, LoopWatchdog, exit_now, exit_with_error
from common.process.log import BusLog, log_to_stderr
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
_ROUTER_WARNING_SECONDS = 2.0  # without a router before that is logged
# A computing thread yields to the loop this often. The default of 5 ms would delay each message by as much.
_SWITCH_SECONDS = 0.0005
_RELEASE_MEMORY_SECONDS = 20.0


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        exit_with_error(ConfigError(self.prog, message, "is not valid; --help lists the options"))


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
    topics: Mapping[str, str] = field(default_factory=dict)  # keys of the cell by the names that the service uses


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of every service process."""
    parser.add_argument("--name", help="name of this service in the cell; default: the name of its module")
    parser.add_argument("--cell", help=f"name or YAML file of the cell ({CELL_VARIABLE})")
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE",
        help="override a value of the cell; @FILE: the values of a YAML file",
    )
    parser.add_argument("--world", help="name or YAML file of another world")
    parser.add_argument("--seed", type=int, help="seed of all random numbers")
    parser.add_argument("--speed", type=float, help=f"speed of cell time, 0.1 to 10 ({SPEED_VARIABLE})")
    parser.add_argument("--domain", help="0 to 232 (ZENCELL_DOMAIN, 42)")
    parser.add_argument("--connect", metavar="ENDPOINT", help="endpoint of another router (ZENCELL_CONNECT)")
    add_process_options(parser)


def add_process_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of every process, the router included."""
    parser.add_argument("--gate", action="store_true", help="wait for a line on stdin; exit at the end of stdin")
    parser.add_argument("--log-json", action="store_true", help="write log lines as JSON")


def clock_from(speed: float | None, environ: Mapping[str, str] = os.environ) -> Clock:
    """Return the clock that the environment describes, at another speed if one is given.

    Raises:
        ConfigError: speed or epoch are not valid.
    """
    variables = dict(environ)
    if speed is not None:
        variables[SPEED_VARIABLE] = repr(speed)
    try:
        return Clock.from_environment(variables)
    except ValueError as error:
        names = (SPEED_VARIABLE, EPOCH_VARIABLE, BOOTED_VARIABLE, CLOCK_FOLDER_VARIABLE)
        given = {name: variables[name] for name in names if name in variables}
        raise ConfigError("speed", given, f"is not valid: {error}") from None


def prepare(kind: str, config: type[P], options: argparse.Namespace) -> Start[P]:
    """Resolve everything that a service is started with.

    Args:
        kind: last part of the name of its module, and its default name.
        config: parameters class of that module.
        options: of the command line.

    Raises:
        ConfigError, UnknownName: one line with the field, the value and the choices.
    """
    chosen = options.cell or os.environ.get(CELL_VARIABLE)
    if not chosen:
        raise ConfigError("--cell", "", f"must name a cell; {CELL_VARIABLE} is read too")
    endpoint = endpoint_of(options.domain, options.connect)
    overrides = [*json.loads(os.environ.get(OVERRIDES_VARIABLE, "[]")), *options.set]
    cell = load_cell(chosen, overrides, world=options.world, seed=options.seed)
    name = name_in(cell, kind, options.name)
    folder = secure_folder()
    credentials = credentials_of(common_name(cell.name, name), folder) if folder else None
    clock = clock_from(options.speed)
    renamed = cell.services[name].topics if name in cell.services else {}
    return Start(
        name, cell.name, service_config(cell, name, config), clock, endpoint, cell.watchdogs, credentials, renamed)


def name_in(cell: Cell, kind: str, given: str | None) -> str:
    """Return the name of a service in a cell; a service that the cell does not have is named after its kind.

    Raises:
        ConfigError, UnknownName: the cell has no service of that name and kind, or needs a name to choose one.
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
    """Return the name of the module that was started with `python -m`."""
    main_module = sys.modules["__main__"]
    spec = getattr(main_module, "__spec__", None)
    if spec is not None:
        return str(spec.name).rpartition(".")[2]
    return Path(getattr(main_module, "__file__", None) or "service").stem


def main(run: Run[P], config: type[P]) -> NoReturn:
    """Run the service `run(bus, config)` in this process, then exit.

    Exit codes: 0 after SIGINT, SIGTERM, the end of the supervisor or of `run`; 2 for bad input, with one line on
    stderr; 1 for a crash, with its traceback.
    """
    sys.setswitchinterval(_SWITCH_SECONDS)
    use_single_memory_arena()
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
        exit_with_error(error)
    exit_now(run_until_stopped(lambda: _live(run, start, lifeline), lifeline))


def run_until_stopped(life: Callable[[], Coroutine[Any, Any, int]], lifeline: Lifeline) -> int:
    """Return the exit code of a coroutine that the lifeline cancels.

    The loop is not closed afterwards: asyncio.run would wait for threads that still compute.
    """
    loop = asyncio.new_event_loop()
    task = loop.create_task(life())

    def cancel() -> None:
        task.cancel()

    lifeline.on_stop(lambda: call_on_loop(loop, cancel))
    try:
        return loop.run_until_complete(task)
    except asyncio.CancelledError:
        return 0 if lifeline.stopping else 1


async def _live(run: Run[P], start: Start[P], lifeline: Lifeline) -> int:
    session = await _connected(start)
    try:
        await _pass_gate(lifeline)
        bus = Bus(session, service=start.name, cell=start.cell, clock=start.clock, topics=start.topics)
        bus.endpoint = start.endpoint
        root = logging.getLogger()
        to_topic = BusLog(bus)
        root.addHandler(to_topic)
        expiry = asyncio.create_task(_watch_certificate(bus, start.credentials))
        watchdog = LoopWatchdog(
            asyncio.get_running_loop(), lambda: _longest_stall(start.watchdogs, bus.ready_event.is_set()))
        memory = asyncio.create_task(_tidy_memory(bus), name="tidy memory")
        try:
            return await serve(run, bus, start.config, lifeline)
        finally:
            memory.cancel()
            watchdog.stop()
            expiry.cancel()
            root.removeHandler(to_topic)
            await bus.close()
    finally:
        await close_within(session, _CLOSE_SECONDS)


async def _watch_certificate(bus: Bus, credentials: Credentials | None) -> None:
    """Log when the certificate of the process is about to expire, in the same words as the page."""
    if credentials is None:
        return
    watch = CertificateMonitor(credentials.certificate.parent, frozenset([credentials.certificate.stem]))
    await bus.ready_event.wait()
    while True:
        watch.log_new(bus.log)
        await asyncio.sleep(PERIOD)


async def _tidy_memory(bus: Bus) -> None:
    """Exclude modules and models from garbage collection once the service is ready, then release free memory.

    A full collection over them takes 50 ms, in which no set-point is sent.
    """
    await bus.ready_event.wait()
    gc.freeze()
    while True:
        await asyncio.sleep(_RELEASE_MEMORY_SECONDS)
        release_free_memory()


def _longest_stall(watchdogs: Watchdogs, ready: bool) -> float:
    """Return how long the loop may stall [s]: a service that starts may block it to load what it needs."""
    return watchdogs.loop if ready or not watchdogs.loop else max(watchdogs.loop, watchdogs.start)


async def _connected(start: Start[P]) -> ZenohSession:
    opening = asyncio.ensure_future(open_zenoh(start.endpoint, start.credentials))
    try:
        done, _ = await asyncio.wait({opening}, timeout=_ROUTER_WARNING_SECONDS)
        if not done:
            log.warning("no router at %s yet, waiting for it", start.endpoint)
        return await opening
    finally:
        opening.cancel()


async def _pass_gate(lifeline: Lifeline) -> None:
    if lifeline.gate_open.is_set():
        return
    opened = asyncio.Event()
    loop = asyncio.get_running_loop()
    lifeline.on_gate(lambda: call_on_loop(loop, opened.set))
    await opened.wait()


class StopState(Protocol):
    """Whether and why a service has to stop; a `Lifeline` is one."""

    @property
    def stopping(self) -> bool:
        """Whether it has to."""

    @property
    def reason(self) -> str:
        """The reason."""


async def serve(run: Run[P], bus: Bus, config: P, lifeline: StopState) -> int:
    """Run the service on a bus and return the exit code of its process."""
    try:
        bus.defer_writes()
        serve_parameters(bus, config)
        await bus.run(run(bus, config))
    except (ConfigError, UnknownName) as error:  # bad input that shows only in use, such as a missing URDF
        bus.log.error("%s", located(error, config, bus.service))
        return 2
    except asyncio.CancelledError:
        if not lifeline.stopping:
            bus.log.error("the service cancelled itself")
            return 1
        bus.log.info("stopped: %s", lifeline.reason)
    except Exception:
        bus.log.exception("crashed")
        return 1
    return 0


def serve_parameters(bus: Bus, config: Parameters) -> None:
    """Serve `param/<service>`: list the parameters, and change them in place between two turns of the loop."""
    started = values_of(config, bus.service)

    async def handle(request: ParameterRequest) -> ParameterReply:
        changes = checked(config, bus.service, request.set)
        if changes and not request.dry_run:
            lines = [str(change) for change in changes]
            apply(changes)
            for line in lines:
                bus.log.info("%s (by %s)", line, request.by or "unknown operator")
            bus.parameters_changed()
            await bus.save_parameters()
        parameters = describe(config, bus.service, started)
        return ParameterReply(header=bus.header(), service=bus.service, parameters=parameters)

    bus.serve(topics.parameters_of(bus.service), handle)
