"""What a cell's processes are started with: command lines, environment, and the router's port."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from common.application import import_folders, import_from_working_directory
from common.clock import MAX_SPEED, MIN_SPEED, Clock
from common.config import Cell, ServiceEntry
from common.errors import ConfigError
from common.transport.endpoint import NEAR_VARIABLE, endpoint_of

ROUTER_MODULE = "services.router"
PROJECT_ROOT = Path(__file__).resolve().parent.parent.parent


@dataclass(frozen=True)
class Launch:
    """How a cell was asked for; every process resolves the same cell from it."""

    cell: str  # name, or path of a YAML file
    overrides: tuple[str, ...] = ()
    world: str | None = None
    seed: int | None = None
    domain: int = 42
    connect: str | None = None  # endpoint of a router that runs already
    listen: tuple[str, ...] = ()  # where our router listens, when not for its own host only
    link: tuple[str, ...] = ()  # routers of other hosts that it is linked with
    near: tuple[str, ...] = ()  # where it listens besides, for what we start, by turns
    log_json: bool = False
    clock: Clock = field(default_factory=Clock)
    extra: Mapping[str, str] = field(default_factory=dict, repr=False)  # environment that no command line may show

    def router_command(self, small: Sequence[str] = ()) -> list[str]:
        """Command line of the router; `small` are keys of the cell's own under which nothing large travels."""
        command = [*python_module(ROUTER_MODULE), "--domain", str(self.domain)]
        for option, values in (
            ("--listen", self.listen), ("--link", self.link), ("--near", self.near), ("--small", small),
        ):
            for value in values:
                command += [option, value]
        return [*command, *self._process_options()]

    def service_command(self, entry: ServiceEntry, *, gate: bool = True) -> list[str]:
        """Command line of a service, which waits behind its gate unless told otherwise."""
        command = [*python_module(entry.module), *entry.name_option, "--cell", self.cell]
        for text in self.overrides:
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
        """Environment of every process: the caller's, what is extra, where the router is near, clock, and packages."""
        near = {NEAR_VARIABLE: f"{endpoint_of(self.domain)}={','.join(self.near)}"} if self.near else {}
        return {**inherited, **self.extra, **near, **self.clock.environment(),
                "PYTHONPATH": python_path(inherited, self.cell)}


def clock_of(speed: float, epoch: int | None = None) -> Clock:
    """A clock of that speed, from now on or from an epoch [ns since the Unix epoch].

    Raises:
        ConfigError: the speed is out of bounds.
    """
    try:
        return Clock(speed, epoch)
    except ValueError:
        raise ConfigError("--speed", speed, f"must be {MIN_SPEED:g} to {MAX_SPEED:g}") from None


def place_of(
    domain: str | None, connect: str | None, environ: Mapping[str, str] = os.environ
) -> tuple[int, str | None]:
    """The domain, and the endpoint of a router that runs already or None, from options and environment.

    Raises:
        ConfigError: one of them is not valid.
    """
    from common.transport.endpoint import CONNECT_VARIABLE, DEFAULT_DOMAIN, DOMAIN_VARIABLE, endpoint_of, parse_domain

    if connect or (domain is None and environ.get(CONNECT_VARIABLE)):
        return DEFAULT_DOMAIN, endpoint_of(None, connect, environ)
    if domain is not None:
        return parse_domain(domain), None
    return parse_domain(environ.get(DOMAIN_VARIABLE, DEFAULT_DOMAIN), DOMAIN_VARIABLE), None


def python_module(module: str) -> list[str]:
    """Command line that runs a module with this interpreter."""
    # -P: a folder named `services` or `common` where the person stands must not hide the project's own.
    return [sys.executable, "-P", "-m", module]


def python_path(inherited: Mapping[str, str] = os.environ, cell: str = "") -> str:
    """PYTHONPATH of the processes: the project, then the caller's, the working directory, and what is beside a cell.

    Args:
        inherited: the caller's environment.
        cell: name, or path of a YAML file.
    """
    given = [part for part in inherited.get("PYTHONPATH", "").split(os.pathsep) if part]
    places = [str(PROJECT_ROOT), *given, str(Path.cwd()), *import_folders(cell)]
    return os.pathsep.join(dict.fromkeys(places))


def require_modules(cell: Cell) -> None:
    """Return when every service of the cell that is not the project's own can be found.

    Raises:
        ConfigError: names the first that cannot.
    """
    for entry in cell.services.values():
        require_module(entry.name if entry.name != entry.kind else entry.module.removeprefix("services."), entry)


def require_module(key: str, entry: ServiceEntry) -> None:
    """Return when the module of a service, which goes by `key` in the cell, can be found.

    Raises:
        ConfigError: it cannot.
    """
    import_from_working_directory()
    try:
        found = importlib.util.find_spec(entry.module) is not None
    except ModuleNotFoundError:
        found = False
    if not found:
        raise ConfigError(f"services.{key}", entry.module, "is not a module that can be found from here")


def free_endpoints(count: int) -> tuple[str, ...]:
    """So many endpoints of a secured router on this host only, where nobody listens."""
    with contextlib.ExitStack() as held:
        probes = [held.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return tuple(f"tls/127.0.0.1:{probe.getsockname()[1]}" for probe in probes)


def require_free_port(endpoint: str) -> None:
    """Return when a router can listen at an endpoint of this host.

    Raises:
        PortInUse: names the domain, the port and, where it can be seen, the process that holds it.
    """
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections that just closed do not matter
        try:
            probe.bind((host, int(port)))
        except OSError:
            from common.transport.router import PortInUse, holder_of

            raise PortInUse(endpoint, holder_of(int(port))) from None


def process_began() -> float:
    """When this process was started [s, monotonic], its imports included."""
    import psutil

    age = time.time() - psutil.Process().create_time()
    return time.monotonic() - (age if 0 <= age < 60 else 0.0)
