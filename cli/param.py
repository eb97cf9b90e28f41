"""Parameters of running services: what there is, changing it, and keeping it in a file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import completion, options
from common.errors import ConfigError
from common.terminal import echo

if TYPE_CHECKING:
    from common.client.parameters import Listing
    from common.messages import Parameter
    from common.transport.bus import Bus

app = typer.Typer(help="Parameters of running services: what there is, and changing it.", no_args_is_help=True)

LONGEST_VALUE = 28  # characters of a value in a table

PathArgument = Annotated[
    str, typer.Argument(metavar="PATH", help="as in `zencell param list`; services. may be left out",
                        autocompletion=completion.parameters)
]
Assignments = Annotated[
    list[str], typer.Argument(metavar="PATH=VALUE...", help="values as YAML; @FILE: all of a file of `param dump`",
                              autocompletion=completion.overrides)
]


@app.command("list")
def list_(
    service: Annotated[
        str | None, typer.Argument(metavar="SERVICE", help="of one; of all if not given",
                                   autocompletion=completion.services)
    ] = None,
    cell: options.CellName = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """List parameters: path, value, whether a change needs a restart, range, and what it is."""
    from cli.inspection import inspect
    from common.client.parameters import listing
    from common.config import yaml_line
    from common.messages.schema import to_json

    async def visit(bus: Bus) -> Listing:
        return await listing(bus, [service] if service else None)

    found = inspect(visit, cell=cell, domain=domain, connect=connect)
    rows = [(name, parameter) for name, parameters in found.parameters.items() for parameter in parameters]
    width = max((len(parameter.path) for _, parameter in rows), default=0)
    for name, parameter in rows:
        if as_json:
            echo(to_json({"service": name, **parameter.model_dump()}))
            continue
        value = yaml_line(parameter.value)
        value = value if len(value) <= LONGEST_VALUE else f"{value[: LONGEST_VALUE - 3]}..."
        how = "live" if parameter.runtime else "restart"
        meaning = "; ".join(text for text in (range_of(parameter), parameter.description) if text)
        echo(f"{parameter.path:<{width}}  {value:<{LONGEST_VALUE}}  {how:<7}  {meaning}".rstrip())
    found.raise_first()


@app.command()
def get(
    path: PathArgument,
    cell: options.CellName = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Print the value of a parameter as YAML; with --json everything that is known of it."""
    from cli.inspection import inspect
    from common.client.parameters import look_up
    from common.config import yaml_line
    from common.messages.schema import to_json

    async def visit(bus: Bus) -> tuple[str, Parameter]:
        return (await look_up(bus, [path]))[path]

    service, parameter = inspect(visit, cell=cell, domain=domain, connect=connect)
    echo(to_json({"service": service, **parameter.model_dump()}) if as_json else yaml_line(parameter.value))


@app.command("set", context_settings={"ignore_unknown_options": True})
def set_(
    assignments: Assignments,
    cell: options.CellName = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Change parameters at once, all of them or none, and say what was changed."""
    from cli.inspection import inspect
    from common.client.parameters import change
    from common.config import expanded, parse_override

    values = {}
    for text in expanded(assignments):
        parts, value = parse_override(text, "param set")
        values[".".join(parts)] = value

    async def visit(bus: Bus) -> dict[str, tuple[Any, Any]]:
        return await change(bus, values)

    for path, (before, after) in inspect(visit, cell=cell, domain=domain, connect=connect).items():
        echo(f"{path}: is {_line(before)} already" if before == after else f"{path}: {_line(before)} -> {_line(after)}")


@app.command()
def dump(
    services: Annotated[
        list[str] | None, typer.Argument(metavar="SERVICE...", help="all if none is given",
                                         autocompletion=completion.services)
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="what is as by default, too")] = False,
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE", help="write there, not here")] = "",
    cell: options.CellName = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Write what differs from the defaults as YAML in the shape of a cell file; `--set @FILE` reads it back."""
    import yaml

    from cli.inspection import inspect
    from common.client.parameters import listing

    async def visit(bus: Bus) -> tuple[str, Listing]:
        return bus.cell, await listing(bus, services or None)

    name, found = inspect(visit, cell=cell, domain=domain, connect=connect)
    found.raise_first()  # half of it would look like all of it
    tree = tree_of(p for parameters in found.parameters.values() for p in parameters if everything or differs(p))
    text = f"# Parameters of {name}; read back with: zencell up {name} --set @FILE\n"
    text += yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)
    if not output:
        echo(text, nl=False)
        return
    try:
        Path(output).expanduser().write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError("--output", output, f"cannot be written: {error.strerror or error}") from None


def differs(parameter: Parameter) -> bool:
    """Whether a cell needs to be told the value, to start with it."""
    return parameter.changed or parameter.value != parameter.default


def tree_of(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """The values in the shape of a cell file."""
    tree: dict[str, Any] = {}
    for parameter in parameters:
        *above, name = parameter.path.split(".")
        node = tree
        for part in above:
            node = node.setdefault(part, {})
        node[name] = parameter.value
    return tree


def range_of(parameter: Parameter) -> str:
    """Bounds or choices in a few words."""
    if parameter.choices:
        return " | ".join(parameter.choices)
    low, high = parameter.minimum, parameter.maximum
    if low is None or high is None:
        return f">= {low:g}" if low is not None else f"<= {high:g}" if high is not None else ""
    return f"{low:g} to {high:g}"


def _line(value: Any) -> str:
    from common.config import yaml_line

    return yaml_line(value)
