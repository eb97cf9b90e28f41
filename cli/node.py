"""Who is there: the services that have said that they are ready, and what each has to do with."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import completion, options
from common.errors import UnknownName
from common.terminal import echo

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from cli.inspection import Presence
    from common.config import Cell, ServiceEntry
    from common.graph.wired import Wired
    from common.messages import Parameter, ParameterReply
    from common.topics import Request, Topic
    from common.transport.bus import Bus

app = typer.Typer(help="Services: who is ready, and what each has to do with.", no_args_is_help=True)


@app.callback()
def node() -> None:
    """Services: who is ready, and what each has to do with."""


@app.command("list")
def list_(
    cell: options.CellName = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
    as_json: options.Json = False,
) -> None:
    """List the services that are ready now, of all cells unless one is named."""
    from cli.inspection import inspect
    from common.client.joining import alive
    from common.errors import NoResponder

    found = inspect(alive, domain=domain, connect=connect)
    shown = [(name, service) for name, service in found if cell in (None, name)]
    if not shown:
        raise NoResponder(f"{cell or '*'}/alive/*")
    for name, service in shown:
        echo(json.dumps({"cell": name, "service": service}) if as_json else f"{name}/{service}")


ASK_TIMEOUT = 2.0  # [s]
SIDES = ("reads", "writes", "serves", "calls")


@app.command()
def info(
    service: Annotated[
        str, typer.Argument(metavar="SERVICE", help="as in the cell file", autocompletion=completion.services)
    ],
    cell: Annotated[
        str | None, typer.Option("--cell", metavar="CELL", help="name or YAML file of its cell",
                                 autocompletion=completion.cells)
    ] = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show what a service reads, writes, serves and calls, its parameters, and how it is while a cell is up."""
    from cli.inspection import look
    from common.graph.wired import wired

    cells = look(domain, connect)
    loaded, entry = _find(service, cell, cells)
    found = wired(loaded, entry)
    presence = cells.get(loaded.name)
    parameters = _parameters(found, loaded, presence, domain, connect)
    described = _described(loaded, found, presence, parameters)
    if as_json:
        echo(json.dumps(described))
        return
    for line in _lines(described, found.topics):
        echo(line)


def _find(service: str, cell: str | None, cells: dict[str, Presence]) -> tuple[Cell, ServiceEntry]:
    """The cell that a service belongs to, those that are up first, and its entry there.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    from common.config import ServiceEntry, load_cell, names_of, service_names
    from common.transport.keys import ROUTER

    names = [cell] if cell else sorted(names_of("cells"), key=lambda name: (name not in cells, name))
    choices = {name for name in service_names() if name != ROUTER}
    for name in names:
        loaded = load_cell(name)
        for entry in loaded.services.values():
            if service in (entry.name, entry.module):
                return loaded, entry
            choices.add(entry.name)
    if service not in choices:
        raise UnknownName("service", service, choices)
    # One that no cell has: as it would be in the first.
    return load_cell(names[0]), ServiceEntry(name=service, module=f"services.{service}")


def _parameters(
    found: Wired, cell: Cell, presence: Presence | None, domain: str | None, connect: str | None
) -> list[Parameter]:
    """The parameters as they are in the running service, else as they would be."""
    from cli.inspection import inspect
    from common import topics
    from common.config.tunables import describe
    from common.errors import RequestFailed
    from common.messages import ParameterRequest

    assert found.config is not None
    if presence is not None and found.name in presence.ready:

        async def visit(bus: Bus) -> ParameterReply:
            return await bus.client(topics.parameters_of(found.name)).call(ParameterRequest(), ASK_TIMEOUT)

        try:
            return inspect(visit, cell=cell.name, domain=domain, connect=connect).parameters
        except RequestFailed as error:
            echo(f"zencell: {error}; what follows is from the cell file", err=True)
    return describe(found.config, found.name)


def _described(
    cell: Cell, found: Wired, presence: Presence | None, parameters: list[Parameter]
) -> dict[str, Any]:
    from common.messages import ServiceStatus

    state = "ready" if presence is not None and found.name in presence.ready else "not running"
    status = ServiceStatus(name=found.name, state="stopped")
    for each in presence.status.services if presence and presence.status else []:
        if each.name == found.name:
            status, state = each, each.state
    return {
        "cell": cell.name, "service": found.name, "doc": found.doc, "state": state, "pid": status.pid,
        "restarts": status.restarts, "ready_seconds": status.ready_seconds,
        **{side: getattr(found, side) for side in SIDES},
        "parameters": [each.model_dump() for each in parameters],
    }


def _lines(described: dict[str, Any], topics: Mapping[str, Topic[Any] | Request[Any, Any]]) -> Iterator[str]:
    yield f"{described['cell']}/{described['service']}: {described['doc']}"
    yield f"state: {described['state']}" + (
        f", pid {described['pid']}, {described['restarts']} restarts" if described["pid"] else ""
    )
    for side in SIDES:
        yield f"{side}:" if described[side] else f"{side}: nothing"
        for key in described[side]:
            topic = topics.get(key)
            answer = getattr(topic, "answer", None)
            carries = f"{topic.kind:<8} {topic.message.__name__}" if topic else ""
            yield f"  {key:<28} {carries}{f' -> {answer.__name__}' if answer else ''}".rstrip()
    yield "parameters:" if described["parameters"] else "parameters: none"
    for each in described["parameters"]:
        yield f"  {_parameter_line(each)}"


def _parameter_line(each: dict[str, Any]) -> str:
    low, high = each["minimum"], each["maximum"]
    bounds = " to ".join(f"{value:g}" for value in (low, high) if value is not None)
    if (low is None) != (high is None):
        bounds = f">= {bounds}" if high is None else f"<= {bounds}"
    about = "; ".join(part for part in (each["description"], ", ".join(each["choices"]) or bounds,
                                        "at run time" if each["runtime"] else "") if part)
    return f"{each['path']} = {json.dumps(each['value'])}" + (f"  # {about}" if about else "")
