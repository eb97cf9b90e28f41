"""Options that several verbs share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from cli import choices
from common.errors import ConfigError

MOST_PER_SECOND = 1000.0  # messages or lines

CellArgument = Annotated[
    str, typer.Argument(metavar="CELL", help="a name of `zencell cells`, or the path of a YAML file",
                        autocompletion=choices.cells)
]
CellName = Annotated[
    str | None, typer.Option("--cell", metavar="NAME", help="which cell; not needed while only one is up",
                              autocompletion=choices.cells)
]
Domain = Annotated[
    str | None,
    typer.Option("--domain", metavar="N", help="0 to 232; the router's port is 7447 + N [ZENCELL_DOMAIN, 42]"),
]
Connect = Annotated[
    str | None,
    typer.Option("--connect", metavar="ENDPOINT", help="use the router there, start none [ZENCELL_CONNECT]"),
]
Listen = Annotated[
    list[str] | None,
    typer.Option("--listen", metavar="ENDPOINT", help="have the router listen there as well, as tcp/192.168.1.10:7489; "
                                                      "repeatable [ZENCELL_LISTEN]"),
]
Link = Annotated[
    list[str] | None,
    typer.Option("--link", metavar="ENDPOINT", help="link the router with that of another host; repeatable "
                                                    "[ZENCELL_LINK]"),
]
Only = Annotated[
    list[str] | None,
    typer.Option("--only", metavar="SERVICE,...", help="the part of the cell that runs on this host"),
]
Without = Annotated[
    list[str] | None,
    typer.Option("--without", metavar="SERVICE,...", help="all but these, which run on another host"),
]
Secure = Annotated[
    str | None,
    typer.Option("--secure", metavar="DIR", help="certificates of `zencell secure init`: TLS for all [ZENCELL_SECURE]"),
]
PublishedKey = Annotated[
    str, typer.Argument(metavar="KEY", help="as in `zencell topic list`, without the cell",
                        autocompletion=choices.published)
]
Json = Annotated[bool, typer.Option("--json", help="one JSON object a line")]
Count = Annotated[str | None, typer.Option("--count", "-n", metavar="N", help="stop after N")]
Override = Annotated[
    bool, typer.Option("--override", help="although another person holds the robot; is logged with both names")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="PATH=VALUE",
                 help="any value of the cell, as world.count=5, or those of a YAML file, as @FILE; repeatable",
                 autocompletion=choices.overrides),
]
WorldName = Annotated[
    str | None, typer.Option("--world", metavar="NAME", help="another world, by name or path",
                             autocompletion=choices.worlds)
]
Seed = Annotated[str | None, typer.Option("--seed", metavar="N", help="of everything random")]


def write_text(output: str, text: str) -> None:
    """Write a file that --output names.

    Raises:
        ConfigError: it cannot be written.
    """
    try:
        Path(output).expanduser().write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError("--output", output, f"cannot be written: {error.strerror or error}") from None


# Numbers are read here and not by typer, whose errors do not show what was given.


def number(option: str, text: str) -> float:
    """The number that a text says.

    Raises:
        ConfigError: it is none, or not finite.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(option, text, "must be a number")
    return value


def numbers(option: str, text: str) -> list[float]:
    """The numbers that a text says, apart by commas.

    Raises:
        ConfigError: one is none, or not finite.
    """
    return [number(option, part) for part in text.split(",")]


def three(option: str, text: str) -> tuple[float, float, float]:
    """The three numbers that a text says, apart by commas.

    Raises:
        ConfigError: it says others.
    """
    if text.count(",") != 2:
        raise ConfigError(option, text, "must be three numbers apart by commas, as 0.3,-0.1,0")
    x, y, z = numbers(option, text)
    return x, y, z


def whole(option: str, text: str | None, least: int) -> int | None:
    """The whole number that a text says; None when nothing was said.

    Raises:
        ConfigError: it is none, or less than `least`.
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
    """The rate [Hz] that a text says, given to --rate.

    Raises:
        ConfigError: it is none that can be kept.
    """
    value = number("--rate", text)
    if not 0 < value <= MOST_PER_SECOND:
        raise ConfigError("--rate", text, f"must be more than 0 and at most {MOST_PER_SECOND:g} [Hz]")
    return value
