"""Parameters of running services: what there is, changing it, and keeping it in a file."""

from __future__ import annotations

import asyncio
import getpass
import os
import socket
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import completion, options
from common.errors import ConfigError, NoResponder, RemoteError, RequestFailed, UnknownName, ZencellError
from common.terminal import echo

if TYPE_CHECKING:
    from common.messages import Parameter
    from common.transport.bus import Bus

app = typer.Typer(help="Parameters of running services: what there is, and changing it.", no_args_is_help=True)

TIMEOUT = 5.0  # [s] for a service to answer
LONGEST_VALUE = 28  # characters of a value in a table
BAD_INPUT = ("unknown_parameter", "bad_value")  # codes of a refusal that is the fault of what was typed

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
    from cli.schema import to_json
    from common.config import yaml_line

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
    from cli.schema import to_json
    from common.config import yaml_line

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
    from common.config import expanded, parse_override

    values = {}
    for text in expanded(assignments):
        parts, value = parse_override(text, "param set")
        values[".".join(parts)] = value

    async def visit(bus: Bus) -> None:
        found = await look_up(bus, values)
        wanted: dict[str, dict[str, Any]] = {}
        for path, (service, parameter) in found.items():
            if parameter.value == values[path]:
                echo(f"{parameter.path}: is {_line(parameter.value)} already")
            else:
                wanted.setdefault(service, {})[parameter.path] = values[path]
        before = {parameter.path: parameter.value for _, parameter in found.values()}
        for service, changes in wanted.items():
            await ask(bus, service, changes, dry_run=True)
        for service, changes in wanted.items():
            after = {parameter.path: parameter.value for parameter in await ask(bus, service, changes)}
            for path in changes:
                echo(f"{path}: {_line(before[path])} -> {_line(after[path])}")

    inspect(visit, cell=cell, domain=domain, connect=connect)


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


class Listing:
    """The parameters of services by their names, and what became of those that did not answer."""

    def __init__(self, answers: Mapping[str, list[Parameter] | RequestFailed]) -> None:
        self.parameters = {name: answer for name, answer in answers.items() if not isinstance(answer, RequestFailed)}
        self._failures = [answer for answer in answers.values() if isinstance(answer, RequestFailed)]

    def raise_first(self) -> None:
        """Return when all services answered.

        Raises:
            RequestFailed: the first that did not.
        """
        if self._failures:
            raise self._failures[0]


async def serving(bus: Bus) -> list[str]:
    """The services of the cell that answer for their parameters.

    Raises:
        NoResponder: there is none.
    """
    from cli.inspection import LOOK_TIMEOUT
    from common.transport.keys import serves_key

    names = [token.rpartition("/")[2] for token in await bus.raw_tokens(serves_key(bus.cell, "param/*"), LOOK_TIMEOUT)]
    if not names:
        raise NoResponder(f"{bus.cell}/param/*")
    return sorted(set(names))


async def listing(bus: Bus, wanted: Iterable[str] | None) -> Listing:
    """The parameters of services, or of all.

    Raises:
        UnknownName: a service that does not serve any; with the choices.
    """
    there = await serving(bus)
    names = there if wanted is None else list(dict.fromkeys(wanted))
    for name in names:
        if name not in there:
            raise UnknownName("service", name, there)

    async def answer(name: str) -> list[Parameter] | RequestFailed:
        try:
            return await ask(bus, name)
        except RequestFailed as error:
            return error

    answers = await asyncio.gather(*(answer(name) for name in names))
    return Listing(dict(zip(names, answers, strict=True)))


async def ask(
    bus: Bus, service: str, changes: Mapping[str, Any] | None = None, *, dry_run: bool = False
) -> list[Parameter]:
    """The parameters of a service, after a change if there is one.

    Raises:
        ZencellError: what is wrong with the change.
        RequestFailed: the service refuses, or does not answer.
    """
    from pydantic_core import to_jsonable_python

    from common import topics
    from common.config import check
    from common.messages import ParameterRequest

    values = {"set": to_jsonable_python(changes or {}, inf_nan_mode="constants"), "dry_run": dry_run, "by": myself()}
    request = check(ParameterRequest, values)
    try:
        return (await bus.client(topics.parameters_of(service)).call(request, TIMEOUT)).parameters
    except RemoteError as error:
        raise ZencellError(error.message) if error.code in BAD_INPUT else RequestFailed(error.message) from None


async def look_up(bus: Bus, paths: Iterable[str]) -> dict[str, tuple[str, Parameter]]:
    """The service and the parameter that each path stands for.

    Raises:
        UnknownName: a service or parameter that is not there; with the choices.
        RequestFailed: a service that has to be asked does not answer.
    """
    there = await serving(bus)
    full = {path: f"services.{path}" if path.partition(".")[0] in there else path for path in paths}
    owners = {path: path.split(".")[1] if path.startswith("services.") else None for path in full.values()}
    # A section, such as motion, does not say whose it is.
    found = await listing(bus, None if None in owners.values() else [name for name in owners.values() if name])
    known = {p.path: (name, p) for name, parameters in found.parameters.items() for p in parameters}
    for path, owner in owners.items():
        if owner is not None and owner not in there:
            raise UnknownName("service", owner, there)
        if path not in known:
            found.raise_first()  # it may be one of that service
            choices = [p for p in known if owner is None or known[p][0] == owner]
            if owner is None:
                choices = [p for p in known if not p.startswith("services.")] + [f"{name}..." for name in there]
            raise UnknownName("parameter", path, choices)
    return {path: known[whole] for path, whole in full.items()}


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


def myself() -> str:
    """Who asks, for the log of the service."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container may have no name for its user
        user = str(os.getuid())
    return f"{user}@{socket.gethostname()}/{os.getpid()}"


def _line(value: Any) -> str:
    from common.config import yaml_line

    return yaml_line(value)
