"""What a cell's processes are started with: command lines, environment, and the router's port."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from common.clock import Clock
from common.config import ServiceEntry
from common.errors import ConfigError

ROUTER = "router"
ROUTER_MODULE = "services.router"
LOG_JSON_VARIABLE = "ZENCELL_LOG_JSON"
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
    log_json: bool = False
    clock: Clock = field(default_factory=Clock)

    def router_command(self) -> list[str]:
        """Command line of the router."""
        return [*python_module(ROUTER_MODULE), "--domain", str(self.domain), "--gate"]

    def service_command(self, entry: ServiceEntry) -> list[str]:
        """Command line of a service."""
        command = [*python_module(entry.module), "--cell", self.cell]
        for text in self.overrides:
            command += ["--set", text]
        if self.world is not None:
            command += ["--world", self.world]
        if self.seed is not None:
            command += ["--seed", str(self.seed)]
        command += ["--connect", self.connect] if self.connect else ["--domain", str(self.domain)]
        return [*command, "--gate"]

    def environment(self, inherited: Mapping[str, str] = os.environ) -> dict[str, str]:
        """Environment of every process: the caller's, the cell's clock, and where packages are found."""
        environment = {**inherited, **self.clock.environment(), "PYTHONPATH": python_path(inherited)}
        environment[LOG_JSON_VARIABLE] = "1" if self.log_json else ""
        return environment


def python_module(module: str) -> list[str]:
    """Command line that runs a module with this interpreter."""
    # -P: a folder named `services` or `common` where the person stands must not hide the project's own.
    return [sys.executable, "-P", "-m", module]


def python_path(inherited: Mapping[str, str] = os.environ) -> str:
    """PYTHONPATH of the processes: the project first, then the caller's, then the working directory."""
    given = [part for part in inherited.get("PYTHONPATH", "").split(os.pathsep) if part]
    return os.pathsep.join(dict.fromkeys([str(PROJECT_ROOT), *given, str(Path.cwd())]))


def require_free_port(host: str, port: int, domain: int) -> None:
    """Return when the router can listen there.

    Raises:
        ConfigError: names the domain, the port and, where it can be seen, the process that holds it.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections that just closed do not matter
        try:
            probe.bind((host, port))
        except OSError:
            raise ConfigError(
                "--domain", domain,
                f"has its port {port} in use by {port_holder(port)}; "
                "stop that, choose another --domain, or join it with --connect",
            ) from None


def port_holder(port: int) -> str:
    """The process that listens on a TCP port, for people: "zencell run panda (pid 123)"."""
    import psutil

    try:
        for connection in psutil.net_connections("tcp"):
            if connection.laddr and connection.laddr.port == port and connection.status == psutil.CONN_LISTEN:
                if connection.pid is None:
                    break
                command = " ".join(psutil.Process(connection.pid).cmdline())
                return f"pid {connection.pid} ({command[:120]})"
    except (psutil.Error, OSError):  # other people's processes may be hidden from us
        return "another process"
    return "another process"
