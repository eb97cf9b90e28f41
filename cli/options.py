"""Options that several commands share, and numbers in options."""

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
    str | None, typer.Option("--cell", metavar="NAME", help="name of the cell; not needed if only one is running",
                              autocompletion=choices.cells)
]
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
