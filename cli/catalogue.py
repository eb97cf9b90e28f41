"""List cells and services, run one service in the foreground, create a new project."""

from __future__ import annotations

import ast
import importlib.util
import keyword
import os
import re
from pathlib import Path
from typing import Annotated

import typer

from cli import choices, options
from cli.choices import ROOT
from common.errors import ConfigError, UnknownName
from common.terminal import echo

EXAMPLES = ROOT / "examples"  # each folder with a cell file is a kind of task, and its own template
DEFAULT = "sort_cubes"


def cells() -> None:
    """List the cells by name."""
    from common.config import config_root, names_of

    for name in names_of("cells"):
        first = (config_root() / "cells" / f"{name}.yaml").read_text(encoding="utf-8").partition("\n")[0]
        echo(f"{name:<12}  {first.lstrip('# ') if first.startswith('#') else ''}".rstrip())


def services() -> None:
    """List the built-in services."""
    import services as package
    from common.config import service_names

    folder = Path(next(iter(package.__path__)))
    for name in service_names():
        echo(f"{name:<22}  {_first_line(folder / f'{name}.py')}".rstrip())


def _first_line(path: Path) -> str:
    """Return the first line of a module's docstring without importing the module."""
    doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return doc.partition("\n")[0]


def service(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="a service of `zencell services` or of the cell, or a module",
                            autocompletion=choices.services)
    ],
    cell: Annotated[
        str, typer.Option("--cell", metavar="CELL", help="the cell of the service", autocompletion=choices.cells)
    ] = choices.default_cell(),
    overrides: options.Overrides = None,
    world: options.WorldName = None,
    seed: options.Seed = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Run one service of a cell in the foreground; connects to a running cell or router."""
    from common.config import ServiceEntry, load_cell, service_names
    from common.supervision.launch import (
        ROUTER_MODULE,
        Launch,
        module_command,
        pythonpath,
        require_module,
        router_location,
    )
    from common.transport.session import ROUTER

    number, endpoint = router_location(domain, connect)
    launch = Launch(cell, tuple(overrides or ()), world, options.whole("--seed", seed, 0), number, endpoint)
    if name == ROUTER:
        command = [*module_command(ROUTER_MODULE), "--domain", str(number)]
    else:
        entries = {known: ServiceEntry(name=known, module=f"services.{known}") for known in service_names()}
        for entry in load_cell(cell, launch.overrides, world=world, seed=launch.seed).services.values():
            if entry.name == entry.kind:
                entries[entry.module] = entry
            entries[entry.name] = entry
        if name not in entries and "." not in name:
            raise UnknownName("service", name, entries)
        entry = entries.get(name) or ServiceEntry(name=name.rpartition(".")[2], module=name)
        require_module(name, entry)
        command = launch.service_command(entry, gate=False)
    os.execvpe(command[0], command, {**os.environ, "PYTHONPATH": pythonpath()})


def new(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="folder to create; names the cell and the task")],
    task: Annotated[
        str, typer.Option("--task", metavar="KIND", help="template", autocompletion=choices.tasks)
    ] = DEFAULT,
) -> None:
    """Create a folder with a cell, a task in one file and their test, ready to run."""
    kinds = choices.task_kinds()
    if task not in kinds:
        raise UnknownName("task", task, kinds)
    to = Path(folder).expanduser().absolute()
    _require_name(folder, to)
    try:
        if to.exists() and (not to.is_dir() or any(to.iterdir())):
            raise ConfigError("DIR", folder, "is there already and not empty: take another, or empty it")
        to.mkdir(parents=True, exist_ok=True)
        for file in sorted(path for path in (EXAMPLES / task).iterdir() if path.is_file()):
            text = file.read_text(encoding="utf-8").replace(task, to.name)
            (to / file.name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError("DIR", folder, f"cannot be written: {error.strerror}") from None
    for line in ("run {}/cell.yaml", "simulate {}/cell.yaml --seeds 1-3"):
        echo(f"zencell {line.format(folder.rstrip('/') or '.')}")
    echo(f"pytest {folder}")


def _require_name(folder: str, to: Path) -> None:
    """Check that the task can be imported as a module of that folder.

    Raises:
        ConfigError: it cannot; with the reason.
    """
    name = to.name
    if not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) or keyword.iskeyword(name):
        raise ConfigError("DIR", folder, "must end in a name that Python can import: letters, digits and _")
    try:
        found = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        found = None
    if found is not None and [Path(place).absolute() for place in found.submodule_search_locations or ()] != [to]:
        raise ConfigError("DIR", folder, f"has the name of a Python module that is there already: {name!r}")
