"""`node` and `graph`: the services of a cell, and what each reads, writes, serves and calls."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import choices, options
from cli.options import CellTarget, CommandGroup
from common.errors import ConfigError
from common.terminal import echo

if TYPE_CHECKING:
    from common.config import Cell
    from common.supervision.wiring import ServiceWiring
    from tools.graph import Graph

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


FORMATS = (".svg", ".dot", ".mmd")


def graph(
    cell: Annotated[
        str, typer.Argument(metavar="[CELL]", help="name or path of the cell file", autocompletion=choices.cells)
    ] = choices.default_cell(),
    output: Annotated[
        str, typer.Option("-o", "--output", metavar="FILE", help="*.svg, *.dot or *.mmd [Mermaid on stdout]")
    ] = "",
    overrides: options.Overrides = None,
    no_viewer: Annotated[
        bool, typer.Option("--no-viewer", help="leave out the operator's page, which reads nearly every topic")
    ] = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Draw the services and topics of a cell; if the cell is running, services that are not alive are dashed."""
    from common.config import load_cell
    from security.page_tokens import VIEWER
    from tools.graph import graph_of, names

    path = Path(output).expanduser() if output else None
    write = _writer_of(path)
    loaded = load_cell(cell, overrides or ())
    presence = CellTarget(domain=domain, connect=connect).running_cells().get(loaded.name)
    services = [each for each in _wired_services(loaded) if not (no_viewer and each.name == VIEWER)]
    made = graph_of(loaded.name, services, presence.ready if presence else None)
    text = write(made)
    if path is None:
        echo(text, nl=False)
        return
    options.write_text(output, text)
    echo(f"{path}: {len(made.services)} services, {len(made.kinds)} keys"
         f"{'' if made.alive is None else f', {sum(map(made.is_lit, names(made)))} services alive'}")


def _writer_of(path: Path | None) -> Callable[[Graph], str]:
    from tools.graph import dot, mermaid, svg

    writers = dict(zip(FORMATS, (svg, dot, mermaid), strict=True))
    if path is None:
        return mermaid
    if path.suffix not in writers:
        raise ConfigError("--output", str(path), f"must end in {', '.join(FORMATS)}")
    return writers[path.suffix]


def _wired_services(cell: Cell) -> list[ServiceWiring]:
    """Return the services in start order; a service whose wiring fails is drawn without its keys."""
    from common.supervision.wiring import ServiceWiring, WiringFailed, wire_service

    found = []
    for entry in cell.services.values():
        try:
            found.append(wire_service(cell, entry))
        except WiringFailed as error:
            echo(f"zencell: {error}", err=True)
            found.append(ServiceWiring(entry.name, ""))
    return found
