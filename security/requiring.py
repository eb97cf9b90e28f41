"""What `run` and `up` do with `--secure DIR`: all of it is looked at before anything is started."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from common.errors import ConfigError, ZencellError

if TYPE_CHECKING:
    from common.config import Cell
    from common.supervision.launch import Launch

LOOK_TIMEOUT = 120.0  # [s] for the services to declare what they need
SAID = "zencell: "  # before the line in which a command says what is wrong


class NotSecured(ZencellError):
    """The certificates do not fit the cell, or its services cannot say what they need."""

    def __init__(self, message: str, exit_code: int = 2) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def choose(folder: str | None) -> None:
    """Have this process and all that it starts use a folder of certificates, if one was given.

    Raises:
        ConfigError: it is not there.
    """
    from common.transport.credentials import SECURE_VARIABLE

    if folder is None:
        return
    if not folder or not Path(folder).is_dir():
        raise ConfigError("--secure", folder, "is not a folder; make one with `zencell secure init DIR`")
    os.environ[SECURE_VARIABLE] = str(Path(folder).absolute())


def with_near(launch: Launch) -> Launch:
    """The launch with a router of its own in a secured cell listening near what is started with it, too."""
    from common.supervision.launch import free_endpoints
    from common.transport.credentials import secure_folder

    return replace(launch, near=free_endpoints(2)) if secure_folder() and not launch.connect else launch


def require_secured(launch: Launch, cell: Cell) -> None:
    """Return when the cell is an open one, or what this host starts of it can be: router, supervisor, its services.

    Args:
        launch: how the cell was asked for.
        cell: resolved, with the services that are to be started here.

    Raises:
        ConfigError, NotSecured: one line that names the process, what is wrong and what would do.
    """
    from common.transport.credentials import ROUTER_NAME, SUPERVISOR, common_name, read_access, secure_folder
    from common.transport.endpoint import is_encrypted

    folder = secure_folder()
    if folder is None:
        return
    if launch.connect and not is_encrypted(launch.connect):
        raise ConfigError("--connect", launch.connect, "is an open endpoint: with --secure it must be tls/HOST:PORT")
    from security.checking import require_valid

    services = [entry.name for entry in cell.services.values()]
    names = [common_name(cell.name, process) for process in (SUPERVISOR, *services)]
    require_valid(folder, names if launch.connect else [ROUTER_NAME, *names], renewal(str(folder), launch.cell))
    if not launch.connect:
        read_access(folder)
        _require_rules(launch, services, folder)


def require_recorder(launch: Launch, cell: Cell) -> None:
    """Return when the cell is an open one, or its recorder has a certificate.

    Raises:
        ConfigError: it has none that is valid.
    """
    from common.transport.credentials import RECORDER, common_name, secure_folder

    folder = secure_folder()
    if folder is not None:
        from security.checking import require_valid

        require_valid(folder, [common_name(cell.name, RECORDER)], renewal(str(folder), launch.cell))


def _require_rules(launch: Launch, services: Sequence[str], folder: Path) -> None:
    # In a process of its own: what the services import would stay in this one for as long as the cell is up.
    from common.supervision.launch import module_command

    command = [*module_command("cli.main"), "secure", "check", str(folder), "--only-rules", "--cell", launch.cell,
               "--only", ",".join(services)]
    for text in launch.overrides:
        command += ["--set", text]
    if launch.world is not None:
        command += ["--world", launch.world]
    if launch.seed is not None:
        command += ["--seed", str(launch.seed)]
    try:
        done = subprocess.run(
            command, env=launch.environment(), capture_output=True, text=True, timeout=LOOK_TIMEOUT, check=False,
        )
    except subprocess.TimeoutExpired:
        raise NotSecured(f"--secure: the services did not declare what they need within {LOOK_TIMEOUT:g} s") from None
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"`secure check` ended with {done.returncode}"]
        said = [line.removeprefix(SAID) for line in lines if line.startswith(SAID)] or lines
        raise NotSecured(said[-1], done.returncode)


def renewal(folder: str, cell: str) -> str:
    """The command line that makes certificates and rules for a cell anew."""
    from common.config import names_of

    chosen = "" if cell in names_of("cells") else f" --cell {cell}"
    return f"zencell secure init {folder} --renew{chosen}"
