"""`node`: the ready services, and what each reads, writes, serves and calls."""

from __future__ import annotations

import asyncio
import json
from typing import Annotated

import typer

from cli import choices, options
from cli.target import CellTarget, CommandGroup
from common.terminal import echo

app = CommandGroup("List services, and describe what each reads, writes, serves and calls.")


@app.command("list")
def list_(
    cell: options.CellName = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
    as_json: options.Json = False,
) -> None:
    """List the ready services of all cells, or of one."""
    from common.client.joining import ready_services
    from common.errors import NoResponder

    found = CellTarget(domain=domain, connect=connect).visit(ready_services)
    shown = [(name, service) for name, service in found if cell in (None, name)]
    if not shown:
        raise NoResponder(f"{cell or '*'}/alive/*")
    for name, service in shown:
        echo(json.dumps({"cell": name, "service": service}) if as_json else f"{name}/{service}")


@app.command()
def info(
    service: Annotated[
        str, typer.Argument(metavar="SERVICE", help="name in the cell file", autocompletion=choices.services)
    ],
    cell: Annotated[
        str | None, typer.Option("--cell", metavar="CELL", help="name or YAML file of its cell",
                                 autocompletion=choices.cells)
    ] = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show what a service reads, writes, serves and calls, its parameters, and its state if its cell is running."""
    from common.client.inspection import find_service, service_description, service_lines, service_parameters
    from common.supervision.wiring import wire_service

    cells = CellTarget(domain=domain, connect=connect).running_cells()
    loaded, entry = find_service(service, cell, cells)
    wiring, running = wire_service(loaded, entry), cells.get(loaded.name)
    parameters, error = asyncio.run(service_parameters(wiring, loaded.name, running, domain, connect))
    if error is not None:
        echo(f"zencell: {error}; the parameters below are from the cell file", err=True)
    found = service_description(loaded.name, wiring, running, parameters)
    for line in [json.dumps(found)] if as_json else service_lines(found, wiring.topics):
        echo(line)
