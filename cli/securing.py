"""What `run` and `up` do with `--secure DIR`: all of it is looked at before anything is started."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

from cli.secure import renewal
from common.errors import ConfigError, ZencellError

if TYPE_CHECKING:
    from common.config import Cell
    from common.supervision.launch import Launch

LOOK_TIMEOUT = 120.0  # [s] for the services to declare what they need


class NotSecured(ZencellError):
    """The certificates do not fit the cell."""


def choose(folder: str | None) -> None:
    """Have this process and all that it starts use a folder of certificates, if one was given.

    Raises:
        ConfigError: it is not there.
    """
    from common.transport.endpoint import SECURE_VARIABLE

    if folder is None:
        return
    if not folder or not Path(folder).is_dir():
        raise ConfigError("--secure", folder, "is not a folder; make one with `zencell secure init DIR`")
    os.environ[SECURE_VARIABLE] = str(Path(folder).absolute())


def require_secured(launch: Launch, cell: Cell) -> None:
    """Return when the cell is an open one, or its certificates and rules are such that it can be brought up.

    Args:
        launch: how the cell was asked for.
        cell: resolved, with the services that are to be started.

    Raises:
        ConfigError, NotSecured: one line that names the process, what is wrong and what would do.
    """
    from common.security.credentials import OPERATOR, ROUTER_NAME, SUPERVISOR, common_name, secure_folder
    from common.transport.endpoint import is_encrypted

    folder = secure_folder()
    if folder is None:
        return
    if launch.connect and not is_encrypted(launch.connect):
        raise ConfigError("--connect", launch.connect, "is an open endpoint: with --secure it must be tls/HOST:PORT")
    from common.security.checking import require_valid

    processes = [SUPERVISOR, *(entry.name for entry in cell.services.values())]
    names = [OPERATOR, *(common_name(cell.name, process) for process in processes)]
    again = renewal(str(folder), launch.cell)
    require_valid(folder, names if launch.connect else [ROUTER_NAME, *names], again)
    if not launch.connect:
        _require_rules(launch, cell, folder)


def _require_rules(launch: Launch, cell: Cell, folder: Path) -> None:
    # In a process of its own: what the services import would stay in this one for as long as the cell is up.
    from cli.viewing import VIEWER
    from common.supervision.launch import python_module

    command = [*python_module("cli.main"), "secure", "check", str(folder), "--only-rules", "--cell", launch.cell]
    for text in launch.overrides:
        command += ["--set", text]
    if launch.world is not None:
        command += ["--world", launch.world]
    if all(entry.name != VIEWER for entry in cell.services.values()):
        command += ["--no-viewer"]
    try:
        done = subprocess.run(
            command, env=launch.environment(), capture_output=True, text=True, timeout=LOOK_TIMEOUT, check=False,
        )
    except subprocess.TimeoutExpired:
        raise NotSecured(f"--secure: the services did not declare what they need within {LOOK_TIMEOUT:g} s") from None
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"`secure check` ended with {done.returncode}"]
        raise NotSecured(lines[-1].removeprefix("zencell: "))
