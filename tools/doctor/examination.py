"""All checks of a machine in order of importance, and the checks of its robot and cell files."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from tools.doctor import Finding, clocks, fail, machine, network, ok, software


def examine(endpoint: str) -> Iterator[Finding]:
    """Yield all findings; router and cells are checked at an endpoint."""
    yield software.python()
    yield from software.packages()
    yield software.extras()
    yield software.kernel()
    yield from robots()
    yield from cells()
    yield network.router(endpoint)
    yield from network.versions(endpoint)
    yield from clocks.clocks(endpoint)
    yield from network.certificates()
    yield network.page()
    yield from software.cameras()
    yield from machine.processes()
    yield machine.shared_memory()
    yield machine.memory()
    yield machine.cores()
    yield machine.disk()
    yield machine.open_files()
    yield machine.clock()
    yield machine.container_engine()


def robots() -> Iterator[Finding]:
    """Check that every robot file is valid and its description exists."""
    from common.config import RobotConfig, check, config_root, names_of, read_robot
    from common.errors import ZencellError

    for name in names_of("robots"):
        try:
            robot = check(RobotConfig, read_robot(config_root() / "robots" / f"{name}.yaml"))
            needed = [robot.urdf, robot.srdf, *(attachment.urdf for attachment in robot.attachments)]
            missing = [text for text in needed if text and not _described(text, robot.package_dirs)]
        except ZencellError as error:
            yield fail(f"robot {name}: {error}", f"correct {config_root() / 'robots' / f'{name}.yaml'}")
            continue
        if missing:
            yield fail(f"robot {name}: {missing[0]} is missing", "pip install example-robot-data, or correct its path")
        else:
            yield ok(f"robot {name}: description present")


def _described(uri: str, package_dirs: list[str]) -> bool:
    """Return whether a robot description exists, without importing robotics packages."""
    if not uri.startswith("package://"):
        return Path(uri).expanduser().is_file()
    relative = uri.removeprefix("package://")
    roots = [Path(text).expanduser() for text in package_dirs]
    for entry in sys.path:
        roots.append(Path(entry) / "cmeel.prefix" / "share")
    return any((root / relative).is_file() for root in roots)


def cells() -> Iterator[Finding]:
    """Check that every cell is valid, with the parameters of all its services."""
    from common.config import config_root, names_of

    root = config_root()
    given = " (ZENCELL_CONFIG)" if "ZENCELL_CONFIG" in os.environ else ""
    if not root.is_dir():
        yield fail(f"the configuration {root}{given} is not a folder", "set ZENCELL_CONFIG to one, or unset it")
        return
    names = names_of("cells")
    if not names:
        yield fail(f"no cell in {root / 'cells'}{given}", "put a cell file there, or give zencell run the path of one")
    for name in names:
        yield cell(name)


def cell(name: str) -> Finding:
    """Check that a cell is valid, with the parameters of all its services."""
    from common.config import config_root, load_cell, service_config
    from common.errors import ZencellError
    from common.supervision.launch import require_module

    file = config_root() / "cells" / f"{name}.yaml"
    try:
        loaded = load_cell(name)
        for key, entry in loaded.services.items():
            require_module(key, entry)
            service_config(loaded, entry.name, importlib.import_module(entry.module).Config)
    except ZencellError as error:
        return fail(f"cell {name}: {error}", f"correct {file}")
    except Exception as error:  # a module of the user may raise anything
        return fail(f"cell {name}: services cannot be imported: {error!r}", "install what is missing, or correct it")
    return ok(f"cell {name}: {len(loaded.services)} services, all parameters valid")
