"""`node`, `param` and `graph`: the services of a cell, their keys and their parameters."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import choices, options
from cli.options import RUNNING, CellTarget, CommandGroup
from common.errors import ConfigError
from common.terminal import echo

if TYPE_CHECKING:
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
    from common.supervision.wiring import wire_services
    from security.page_tokens import VIEWER
    from tools.graph import graph_of, names

    path = Path(output).expanduser() if output else None
    write = _writer_of(path)
    loaded = load_cell(cell, overrides or ())
    presence = CellTarget(domain=domain, connect=connect).running_cells().get(loaded.name)
    wired = wire_services(loaded, _warn)
    services = [each for each in wired if not (no_viewer and each.name == VIEWER)]
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


def _warn(error: Exception) -> None:
    echo(f"zencell: {error}", err=True)


def schema(
    cell: options.CellArgument,
    out: Annotated[
        str, typer.Option("--out", metavar="FOLDER", help="write asyncapi.json, messages/*.json [AsyncAPI on stdout]")
    ] = "",
    overrides: options.Overrides = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Describe a cell for other languages: JSON Schema of its messages, AsyncAPI of its keys."""
    from common.config import load_cell
    from common.supervision.wiring import wire_services
    from common.transport.endpoint import endpoint_of
    from tools.wire import asyncapi, files

    loaded = load_cell(cell, overrides or ())
    made = loaded.name, wire_services(loaded, _warn), endpoint_of(domain, connect)
    echo(files.write(*made, Path(out).expanduser()) if out else files.to_text(asyncapi.document(*made)))


param = CommandGroup("List, read, change and save parameters of running services.")

LONGEST_VALUE = 28  # characters of a value in a table

PathArgument = Annotated[
    str, typer.Argument(metavar="PATH", help="as in `zencell param list`; services. may be left out",
                        autocompletion=choices.parameters)
]
Assignments = Annotated[
    list[str], typer.Argument(metavar="PATH=VALUE...", help="values as YAML; @FILE: all of a file of `param dump`",
                              autocompletion=choices.overrides)
]


@param.command("list")
def list_parameters(
    service: Annotated[
        str | None, typer.Argument(metavar="SERVICE", help="of one service; of all if not given",
                                   autocompletion=choices.services)
    ] = None,
    at: CellTarget = RUNNING,
    as_json: options.Json = False,
) -> None:
    """List parameters: path, value, whether a change needs a restart, range and description."""
    from common.client.parameters import listing, range_text
    from common.config import yaml_line
    from common.messages.schema import to_json

    found = at.visit(lambda bus: listing(bus, [service] if service else None))
    rows = [(name, parameter) for name, parameters in found.parameters.items() for parameter in parameters]
    width = max((len(parameter.path) for _, parameter in rows), default=0)
    for name, parameter in rows:
        if as_json:
            echo(to_json({"service": name, **parameter.model_dump()}))
            continue
        value = yaml_line(parameter.value)
        value = value if len(value) <= LONGEST_VALUE else f"{value[: LONGEST_VALUE - 3]}..."
        how = "live" if parameter.runtime else "restart"
        bounds = range_text(parameter.choices, parameter.minimum, parameter.maximum)
        meaning = "; ".join(text for text in (bounds, parameter.description) if text)
        echo(f"{parameter.path:<{width}}  {value:<{LONGEST_VALUE}}  {how:<7}  {meaning}".rstrip())
    found.raise_first()


@param.command()
def get(path: PathArgument, at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """Print the value of a parameter as YAML; with --json also type, range and description."""
    from common.client.parameters import look_up
    from common.config import yaml_line
    from common.messages.schema import to_json

    service, parameter = at.visit(lambda bus: look_up(bus, [path]))[path]
    echo(to_json({"service": service, **parameter.model_dump()}) if as_json else yaml_line(parameter.value))


@param.command("set", context_settings={"ignore_unknown_options": True})
def set_(assignments: Assignments, at: CellTarget = RUNNING) -> None:
    """Change parameters at once, all of them or none, and print the changes."""
    from common.client.parameters import change
    from common.config import expanded, parse_override, yaml_line

    values = {}
    for text in expanded(assignments):
        parts, value = parse_override(text, "param set")
        values[".".join(parts)] = value
    for path, (before, after) in at.visit(lambda bus: change(bus, values)).items():
        is_now = f"is {yaml_line(before)} already" if before == after else f"{yaml_line(before)} -> {yaml_line(after)}"
        echo(f"{path}: {is_now}")


@param.command()
def dump(
    services: Annotated[
        list[str] | None, typer.Argument(metavar="SERVICE...", help="all if none is given",
                                         autocompletion=choices.services)
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="also values that equal the default")] = False,
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE", help="file to write [stdout]")] = "",
    at: CellTarget = RUNNING,
) -> None:
    """Write values that differ from the defaults as YAML in the form of a cell file; `--set @FILE` reads it back."""
    from common.client.parameters import dumped

    text = at.visit(lambda bus: dumped(bus, services, everything=everything))
    if output:
        options.write_text(output, text)
    else:
        echo(text, nl=False)
