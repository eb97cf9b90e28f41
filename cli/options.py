"""Options that several commands share, numbers in options, and the running cell that options name."""

from __future__ import annotations

import asyncio
import functools
import inspect
import math
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import aclosing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from cli import choices
from common.errors import ConfigError
from common.terminal import echo

if TYPE_CHECKING:
    from common.client.cell import Cell
    from common.client.joining import RunningCell
    from common.messages import Message
    from common.transport.bus import Bus

MOST_PER_SECOND = 1000.0  # messages or lines
OPTIONAL_VALUES = {"--foxglove": "8765", "--ros2": "0"}  # port to which Foxglove connects by default; domain of ROS 2

CellArgument = Annotated[
    str, typer.Argument(metavar="CELL", help="a name of `zencell cells`, or the path of a YAML file",
                        autocompletion=choices.cells)
]
CellName = Annotated[
    str | None, typer.Option("--cell", metavar="NAME", help="name of the cell; not needed if only one is running",
                              autocompletion=choices.cells)
]
ArmName = Annotated[str | None, typer.Option("--arm", metavar="NAME", help="arm of a cell with several robots")]
Domain = Annotated[
    str | None,
    typer.Option("--domain", metavar="N", help="0 to 232; the router's port is 7447 + N [ZENCELL_DOMAIN, 42]"),
]
Connect = Annotated[
    str | None,
    typer.Option("--connect", metavar="ENDPOINT", help="use this router and start none [ZENCELL_CONNECT]"),
]
Listen = Annotated[
    list[str] | None,
    typer.Option("--listen", metavar="ENDPOINT", help="another endpoint of the router, such as tcp/192.168.1.10:7489; "
                                                      "repeatable [ZENCELL_LISTEN]"),
]
Link = Annotated[
    list[str] | None,
    typer.Option("--link", metavar="ENDPOINT", help="link the router with the router of another host; repeatable "
                                                    "[ZENCELL_LINK]"),
]
Only = Annotated[
    list[str] | None,
    typer.Option("--only", metavar="SERVICE,...", help="start only these services on this host"),
]
Without = Annotated[
    list[str] | None,
    typer.Option("--without", metavar="SERVICE,...", help="start all services but these, which run on another host"),
]
Secure = Annotated[
    str | None,
    typer.Option("--secure", metavar="DIR", help="folder of `zencell secure init`; enables TLS [ZENCELL_SECURE]"),
]
PublishedKey = Annotated[
    str, typer.Argument(metavar="KEY", help="a key of `zencell topic list`, without the cell",
                        autocompletion=choices.published)
]
Json = Annotated[bool, typer.Option("--json", help="print one JSON object per line")]
Count = Annotated[str | None, typer.Option("--count", "-n", metavar="N", help="exit after N lines or messages")]
Override = Annotated[
    bool, typer.Option("--override", help="even if another operator holds the robot; logged with both names")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="PATH=VALUE",
                 help="a value of the cell, such as world.count=5, or those of a YAML file, as @FILE; repeatable",
                 autocompletion=choices.overrides),
]
WorldName = Annotated[
    str | None, typer.Option("--world", metavar="NAME", help="use another world, by name or path",
                             autocompletion=choices.worlds)
]
Seed = Annotated[str | None, typer.Option("--seed", metavar="N", help="seed of all random numbers")]


def with_optional_values(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of `run` and `up` with the values of a --foxglove and a --ros2 that have none."""
    found = list(arguments)
    for option, value in OPTIONAL_VALUES.items() if found[:1] in (["run"], ["up"]) else ():
        if option in found:
            at = found.index(option) + 1
            if at == len(found) or found[at].startswith("-"):
                found.insert(at, value)
    return found


def write_text(output: str, text: str) -> None:
    """Write the file of the option --output.

    Raises:
        ConfigError: it cannot be written.
    """
    try:
        Path(output).expanduser().write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError("--output", output, f"cannot be written: {error.strerror or error}") from None


# Numbers are parsed here and not by typer, whose errors do not show the value.


def number(option: str, text: str) -> float:
    """Return the number in a text.

    Raises:
        ConfigError: it is not a finite number.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(option, text, "must be a number")
    return value


def numbers(option: str, text: str) -> list[float]:
    """Return the numbers in a text, separated by commas.

    Raises:
        ConfigError: one is not a finite number.
    """
    return [number(option, part) for part in text.split(",")]


def three(option: str, text: str) -> tuple[float, float, float]:
    """Return the three numbers in a text, separated by commas.

    Raises:
        ConfigError: there are not three numbers.
    """
    if text.count(",") != 2:
        raise ConfigError(option, text, "must be three numbers separated by commas, such as 0.3,-0.1,0")
    x, y, z = numbers(option, text)
    return x, y, z


def whole(option: str, text: str | None, least: int) -> int | None:
    """Return the whole number in a text, or None without a text.

    Raises:
        ConfigError: it is not a whole number, or less than `least`.
    """
    if text is None:
        return None
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise ConfigError(option, text, f"must be a whole number, {least} or more")
    return value


def rate(text: str) -> float:
    """Return the rate [Hz] of the option --rate.

    Raises:
        ConfigError: it is out of bounds.
    """
    value = number("--rate", text)
    if not 0 < value <= MOST_PER_SECOND:
        raise ConfigError("--rate", text, f"must be more than 0 and at most {MOST_PER_SECOND:g} [Hz]")
    return value


T = TypeVar("T")
Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass(frozen=True)
class CellTarget:
    """A running cell, by the options --cell, --domain and --connect.

    Its methods raise NoCellRunning without a router or a cell, and UnknownName if several cells are running and none
    was named.
    """

    cell: str | None = None
    domain: str | None = None
    connect: str | None = None
    arm: str = ""

    def visit(
        self, visit: Callable[[Bus], Awaitable[T]], *, any_cell: bool = False, identity: str | None = None
    ) -> T:
        """Join the cell's network and return the result of `visit`.

        Args:
            visit: called with a bus in the cell.
            any_cell: join the network; no cell needs to be running.
            identity: certificate to use in a secured cell; default: the operator's.
        """
        from common.client.joining import joined
        from common.transport.credentials import OPERATOR

        async def visited() -> T:
            cell = None if any_cell else self.cell
            async with joined(cell, domain=self.domain, connect=self.connect, any_cell=any_cell,
                              identity=identity or OPERATOR) as bus:
                return await visit(bus)

        return asyncio.run(visited())

    def join(self, visit: Callable[[Cell], Awaitable[T]]) -> T:
        """Join the cell with the Python client and return the result of `visit`."""
        from common.client.cell import Cell
        from common.client.joining import cell_clock
        from common.client.several_arms import chosen_arm

        async def visited(bus: Bus) -> T:
            bus.clock = await cell_clock(bus)
            async with chosen_arm(bus, self.arm) as own, Cell.on(own) as client:
                return await visit(client)

        return self.visit(visited)

    def answer(self, visit: Callable[[Cell], Awaitable[Message]]) -> None:
        """Join the cell with the Python client and print the result of `visit` as JSON."""
        from common.messages.schema import to_json

        echo(to_json(self.join(visit).model_dump()))

    def show(self, lines: Callable[[Bus], AsyncGenerator[str, None]], most: int | None) -> None:
        """Write lines as they come from the cell, at most that many."""

        async def visit(bus: Bus) -> None:
            shown = 0
            async with aclosing(lines(bus)) as coming:
                async for line in coming:
                    echo(line)
                    shown += 1
                    if shown == most:
                        return

        self.visit(visit)

    def running_cells(self) -> dict[str, RunningCell]:
        """Return the running cells by name."""
        from common.client.joining import running_cells

        return asyncio.run(running_cells(self.domain, self.connect))


RUNNING = CellTarget()  # the only running cell, at ZENCELL_DOMAIN or ZENCELL_CONNECT
OF_ARM = CellTarget()  # the same, for commands to one arm
_OPTIONS = {"cell": CellName, "domain": Domain, "connect": Connect}


class CommandGroup(typer.Typer):
    """A group of commands; a parameter `at: CellTarget` becomes the options --cell, --domain and --connect."""

    def __init__(self, about: str = "", **settings: Any) -> None:
        """Create a group with a line of help."""
        super().__init__(**{"help": about, "no_args_is_help": True, **settings})

    def command(self, *name: Any, **settings: Any) -> Callable[[Command], Command]:
        """Return a decorator that adds a command, like typer's."""
        add = super().command(*name, **settings)

        def added(command: Command) -> Command:
            add(_with_options(command))
            return command

        return added


def _with_options(command: Callable[..., T]) -> Callable[..., T]:
    """Replace `at` by its options: --cell in its position, the others last, as in all commands."""
    signature = inspect.signature(command, eval_str=True)
    default = getattr(signature.parameters.get("at"), "default", None)
    if not isinstance(default, CellTarget):
        return command
    chosen = _OPTIONS | ({"arm": ArmName} if default is OF_ARM else {})

    @functools.wraps(command)
    def targeted(
        cell: str | None, domain: str | None, connect: str | None, arm: str | None = None, **given: Any
    ) -> T:
        return command(**given, at=CellTarget(cell, domain, connect, arm or ""))

    added = {name: inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation)
             for name, annotation in chosen.items()}
    shown = [added.pop("cell") if name == "at" else each for name, each in signature.parameters.items()]
    targeted.__signature__ = signature.replace(parameters=[*shown, *added.values()])  # type: ignore[attr-defined]
    return targeted
