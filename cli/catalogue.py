"""What there is to run: cells, services; and one service in the foreground."""

from __future__ import annotations

import ast
import os
from pathlib import Path
from typing import Annotated

import typer

from cli import choices, options
from common.errors import UnknownName
from common.terminal import echo


def cells() -> None:
    """List the cells that can be run by name."""
    from common.config import config_root, names_of

    for name in names_of("cells"):
        first = (config_root() / "cells" / f"{name}.yaml").read_text(encoding="utf-8").partition("\n")[0]
        echo(f"{name:<12}  {first.lstrip('# ') if first.startswith('#') else ''}".rstrip())


def services() -> None:
    """List the services that a cell can be made of."""
    import services as package
    from common.config import service_names

    folder = Path(next(iter(package.__path__)))
    for name in service_names():
        echo(f"{name:<22}  {_first_line(folder / f'{name}.py')}".rstrip())


def _first_line(path: Path) -> str:
    """First line of a module's docstring, without running the module."""
    doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return doc.partition("\n")[0]


def service(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="of `zencell services`, of the cell, or a module",
                            autocompletion=choices.services)
    ],
    cell: Annotated[
        str, typer.Option("--cell", metavar="CELL", help="the cell that it belongs to", autocompletion=choices.cells)
    ] = choices.default_cell(),
    overrides: options.Overrides = None,
    world: options.WorldName = None,
    seed: options.Seed = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Run one service of a cell in the foreground, beside a cell that is up or its own router."""
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
    os.execvpe(command[0], command, {**os.environ, "PYTHONPATH": pythonpath(cell=cell)})
