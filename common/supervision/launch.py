"""Command lines and environment of a cell's processes, and the port of its router."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from common.clock import MAX_SPEED, MIN_SPEED, Clock
from common.config import OVERRIDES_VARIABLE, Cell, ServiceEntry
from common.errors import ConfigError
from common.plugins import import_from_working_directory, where_searched
from common.transport.endpoint import (
    CONNECT_VARIABLE,
    DEFAULT_DOMAIN,
    DOMAIN_VARIABLE,
    NEAR_VARIABLE,
    endpoint_of,
    parse_domain,
)

ROUTER_MODULE = "services.router"
PROJECT_ROOT = Path(__file__).resolve().parent.parent.parent
OWN_MODULE = Path(__file__).with_name("own_module.py")


@dataclass(frozen=True)
class Launch:
    """The options that a cell was launched with; every process resolves the same cell from them."""

    cell: str  # name, or path of a YAML file
    overrides: tuple[str, ...] = ()
    world: str | None = None
    seed: int | None = None
    domain: int = 42
    connect: str | None = None  # endpoint of a router that already runs
    listen: tuple[str, ...] = ()  # endpoints of our router for other hosts
    link: tuple[str, ...] = ()  # endpoints of routers on other hosts that ours links to
    near: tuple[str, ...] = ()  # additional endpoints of our router for our own processes, in turn
    log_json: bool = False
    clock: Clock = field(default_factory=Clock)
    extra: Mapping[str, str] = field(default_factory=dict, repr=False)  # variables that no command line may show

    def router_command(self, small: Sequence[str] = ()) -> list[str]:
        """Return the command line of the router; `small` are keys of the cell that carry only small messages."""
        command = [*module_command(ROUTER_MODULE), "--domain", str(self.domain)]
        for option, values in (
            ("--listen", self.listen), ("--link", self.link), ("--near", self.near), ("--small", small),
        ):
            for value in values:
                command += [option, value]
        return [*command, *self._process_options()]

    def service_command(self, entry: ServiceEntry, *, gate: bool = True) -> list[str]:
        """Return the command line of a service; with `gate` it waits behind its gate, and gets overrides unseen."""
        command = [*module_command(entry.module), *entry.name_option, "--cell", self.cell]
        for text in () if gate else self.overrides:
            command += ["--set", text]
        if self.world is not None:
            command += ["--world", self.world]
        if self.seed is not None:
            command += ["--seed", str(self.seed)]
        command += ["--connect", self.connect] if self.connect else ["--domain", str(self.domain)]
        return [*command, *self._process_options()] if gate else command

    def _process_options(self) -> list[str]:
        return ["--gate", "--log-json"] if self.log_json else ["--gate"]

    def environment(self, inherited: Mapping[str, str] = os.environ) -> dict[str, str]:
        """Return the environment of every process: inherited and extra variables, near endpoints, clock, PYTHONPATH."""
        # Every user of the host can read command lines, and an override may be a token.
        overrides = {OVERRIDES_VARIABLE: json.dumps(self.overrides)} if self.overrides else {}
        near = {NEAR_VARIABLE: f"{endpoint_of(self.domain)}={','.join(self.near)}"} if self.near else {}
        return {**inherited, **self.extra, **overrides, **near, **self.clock.environment(),
                "PYTHONPATH": pythonpath(inherited)}


def clock_at_speed(speed: float, epoch: int | None = None) -> Clock:
    """Return a clock at a speed that starts now or at an epoch [ns since the Unix epoch].

    Raises:
        ConfigError: the speed is out of bounds.
    """
    try:
        return Clock(speed, epoch)
    except ValueError:
        raise ConfigError("--speed", speed, f"must be {MIN_SPEED:g} to {MAX_SPEED:g}") from None


def router_location(
    domain: str | None, connect: str | None, environ: Mapping[str, str] = os.environ
) -> tuple[int, str | None]:
    """Return the domain and the endpoint of another router, or None, from options and environment.

    Raises:
        ConfigError: one of them is not valid.
    """
    if connect or (domain is None and environ.get(CONNECT_VARIABLE)):
        return DEFAULT_DOMAIN, endpoint_of(None, connect, environ)
    if domain is not None:
        return parse_domain(domain), None
    return parse_domain(environ.get(DOMAIN_VARIABLE, DEFAULT_DOMAIN), DOMAIN_VARIABLE), None


def module_command(module: str) -> list[str]:
    """Return a command line that runs a module with this interpreter."""
    # -P: a folder named `services` or `common` in the working directory must not hide the project's own.
    package = module.partition(".")[0]
    own = [] if package == "zencell" or (PROJECT_ROOT / package).is_dir() else [str(OWN_MODULE)]
    return [sys.executable, "-P", *own, "-m", module]


def pythonpath(inherited: Mapping[str, str] = os.environ) -> str:
    """Return PYTHONPATH of the processes: the project, then the caller's.

    Not the working directory, nor the folder of a cell: a `sitecustomize` or `numpy` there would be imported at once.
    """
    given = [part for part in inherited.get("PYTHONPATH", "").split(os.pathsep) if part]
    return os.pathsep.join(dict.fromkeys([str(PROJECT_ROOT), *given]))


def require_modules(cell: Cell) -> None:
    """Check that the modules of all services of the cell can be found.

    Raises:
        ConfigError: names the first that cannot.
    """
    for entry in cell.services.values():
        require_module(entry.name if entry.name != entry.kind else entry.module.removeprefix("services."), entry)


def require_module(key: str, entry: ServiceEntry) -> None:
    """Check that the module of a service can be found.

    Args:
        key: of the service in the cell file.
        entry: the service.

    Raises:
        ConfigError: it cannot.
    """
    import_from_working_directory(entry.module)
    try:
        found = importlib.util.find_spec(entry.module) is not None
    except ModuleNotFoundError:
        found = False
    if not found:
        raise ConfigError(f"services.{key}", entry.module, where_searched(entry.module))


def free_endpoints(count: int) -> tuple[str, ...]:
    """Return free TLS endpoints of this host, `count` of them."""
    with contextlib.ExitStack() as held:
        probes = [held.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return tuple(f"tls/127.0.0.1:{probe.getsockname()[1]}" for probe in probes)


def require_free_port(endpoint: str) -> None:
    """Check that a router can listen at an endpoint of this host.

    Raises:
        PortInUse: names the domain, the port and, if visible, the process that uses it.
    """
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # ignore connections that just closed
        try:
            probe.bind((host, int(port)))
        except OSError:
            from common.transport.router import PortInUse, port_holder

            raise PortInUse(endpoint, port_holder(int(port))) from None


def process_start_time() -> float:
    """Return when this process was started, before its imports [s, monotonic]."""
    import psutil

    age = time.time() - psutil.Process().create_time()
    return time.monotonic() - (age if 0 <= age < 60 else 0.0)
