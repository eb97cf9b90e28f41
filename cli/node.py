"""Who is there: the services that have said that they are ready, and what each has to do with."""

from __future__ import annotations

import asyncio
import json
from typing import Annotated

import typer

from cli import choices as offers
from cli import options
from cli.target import CellTarget, CommandGroup
from common.terminal import echo

app = CommandGroup("Services: who is ready, and what each has to do with.")


@app.command("list")
def list_(
    cell: options.CellName = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
    as_json: options.Json = False,
) -> None:
    """List the services that are ready now, of all cells unless one is named."""
    from common.client.joining import alive
    from common.errors import NoResponder

    found = CellTarget(domain=domain, connect=connect).visit(alive)
    shown = [(name, service) for name, service in found if cell in (None, name)]
    if not shown:
        raise NoResponder(f"{cell or '*'}/alive/*")
    for name, service in shown:
        echo(json.dumps({"cell": name, "service": service}) if as_json else f"{name}/{service}")


@app.command()
def info(
    service: Annotated[
        str, typer.Argument(metavar="SERVICE", help="as in the cell file", autocompletion=offers.services)
    ],
    cell: Annotated[
        str | None, typer.Option("--cell", metavar="CELL", help="name or YAML file of its cell",
                                 autocompletion=offers.cells)
    ] = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show what a service reads, writes, serves and calls, its parameters, and how it is while a cell is up."""
    from common.client.service import described, find, lines, parameters_of
    from common.supervision.wiring import wire_service

    cells = CellTarget(domain=domain, connect=connect).look()
    loaded, entry = find(service, cell, cells)
    found, presence = wire_service(loaded, entry), cells.get(loaded.name)
    parameters, why = asyncio.run(parameters_of(found, loaded.name, presence, domain, connect))
    if why is not None:
        echo(f"zencell: {why}; what follows is from the cell file", err=True)
    told = described(loaded.name, found, presence, parameters)
    for line in [json.dumps(told)] if as_json else lines(told, found.topics):
        echo(line)
