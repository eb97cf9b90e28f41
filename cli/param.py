"""Parameters of running services: list, read, change, and save them in a file."""

from __future__ import annotations

from typing import Annotated

import typer

from cli import choices, options
from cli.options import RUNNING, CellTarget, CommandGroup
from common.terminal import echo

app = CommandGroup("List, read, change and save parameters of running services.")

LONGEST_VALUE = 28  # characters of a value in a table

PathArgument = Annotated[
    str, typer.Argument(metavar="PATH", help="as in `zencell param list`; services. may be left out",
                        autocompletion=choices.parameters)
]
Assignments = Annotated[
    list[str], typer.Argument(metavar="PATH=VALUE...", help="values as YAML; @FILE: all of a file of `param dump`",
                              autocompletion=choices.overrides)
]


@app.command("list")
def list_(
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


@app.command()
def get(path: PathArgument, at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """Print the value of a parameter as YAML; with --json also type, range and description."""
    from common.client.parameters import look_up
    from common.config import yaml_line
    from common.messages.schema import to_json

    service, parameter = at.visit(lambda bus: look_up(bus, [path]))[path]
    echo(to_json({"service": service, **parameter.model_dump()}) if as_json else yaml_line(parameter.value))


@app.command("set", context_settings={"ignore_unknown_options": True})
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


@app.command()
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
