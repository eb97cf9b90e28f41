"""Checks of `run` and `up` with `--secure DIR`, before any process starts."""

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

WIRING_TIMEOUT = 120.0  # [s] for the services to declare their keys
PREFIX = "zencell: "  # of the error line of a command


class NotSecured(ZencellError):
    """The certificates do not fit the cell, or its services cannot declare their keys."""

    def __init__(self, message: str, exit_code: int = 2) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def choose(folder: str | None) -> None:
    """Use a folder of certificates, if given, in this process and its children.

    Raises:
        ConfigError: it does not exist.
    """
    from common.transport.credentials import SECURE_VARIABLE

    if folder is None:
        return
    if not folder or not Path(folder).is_dir():
        raise ConfigError("--secure", folder, "is not a folder; make one with `zencell secure init DIR`")
    os.environ[SECURE_VARIABLE] = str(Path(folder).absolute())


def with_near(launch: Launch) -> Launch:
    """Return the launch; in a secured cell its own router also listens at endpoints for services of this host."""
    from common.supervision.launch import free_endpoints
    from common.transport.credentials import secure_folder

    return replace(launch, near=free_endpoints(2)) if secure_folder() and not launch.connect else launch


def require_secured(launch: Launch, cell: Cell) -> None:
    """Return if the cell is open, or if router, supervisor and services of this host have valid certificates and rules.

    Args:
        launch: options of the cell.
        cell: resolved, with the services to start here.

    Raises:
        ConfigError, NotSecured: one line that names the process, the problem and the remedy.
    """
    from common.transport.credentials import ROUTER_NAME, SUPERVISOR, common_name, read_access, secure_folder
    from common.transport.endpoint import is_encrypted

    folder = secure_folder()
    if folder is None:
        return
    if launch.connect and not is_encrypted(launch.connect):
        raise ConfigError("--connect", launch.connect, "is an open endpoint: with --secure it must be tls/HOST:PORT")
    from security.validation import require_valid

    services = [entry.name for entry in cell.services.values()]
    names = [common_name(cell.name, process) for process in (SUPERVISOR, *services)]
    require_valid(folder, names if launch.connect else [ROUTER_NAME, *names], renewal(str(folder), launch.cell))
    if not launch.connect:
        read_access(folder)
        _require_rules(launch, services, folder)


def require_recorder(launch: Launch, cell: Cell) -> None:
    """Return if the cell is open, or if its recorder has a valid certificate.

    Raises:
        ConfigError: it has none.
    """
    from common.transport.credentials import RECORDER, common_name, secure_folder

    folder = secure_folder()
    if folder is not None:
        from security.validation import require_valid

        require_valid(folder, [common_name(cell.name, RECORDER)], renewal(str(folder), launch.cell))


def _require_rules(launch: Launch, services: Sequence[str], folder: Path) -> None:
    # In a child process: the imports of the services would stay in the memory of this one while the cell is up.
    from common.supervision.launch import module_command

    command = [*module_command("cli.main"), "secure", "check", str(folder), "--only-rules", "--cell", launch.cell,
               "--only", ",".join(services)]
    for text in launch.overrides:
        if not text.partition("=")[0].endswith("token"):  # a secret, which every user could read in the command line
            command += ["--set", text]
    if launch.world is not None:
        command += ["--world", launch.world]
    if launch.seed is not None:
        command += ["--seed", str(launch.seed)]
    try:
        done = subprocess.run(
            command, env=launch.environment(), capture_output=True, text=True, timeout=WIRING_TIMEOUT, check=False,
        )
    except subprocess.TimeoutExpired:
        raise NotSecured(f"--secure: the services did not declare their keys within {WIRING_TIMEOUT:g} s") from None
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"`secure check` ended with {done.returncode}"]
        errors = [line.removeprefix(PREFIX) for line in lines if line.startswith(PREFIX)] or lines
        raise NotSecured(errors[-1], done.returncode)


def renewal(folder: str, cell: str) -> str:
    """Return the command line that renews certificates and rules of a cell."""
    from common.config import names_of

    chosen = "" if cell in names_of("cells") else f" --cell {cell}"
    return f"zencell secure init {folder} --renew{chosen}"
