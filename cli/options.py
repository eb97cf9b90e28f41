"""Options that several verbs share."""

from __future__ import annotations

from typing import Annotated

import typer

CellArgument = Annotated[
    str, typer.Argument(metavar="CELL", help="a name of `zencell cells`, or the path of a YAML file")
]
CellName = Annotated[
    str | None, typer.Option("--cell", metavar="NAME", help="which cell; not needed while only one is up")
]
Domain = Annotated[
    str | None,
    typer.Option("--domain", metavar="N", help="0 to 232; the router's port is 7447 + N [ZENCELL_DOMAIN, 42]"),
]
Connect = Annotated[
    str | None,
    typer.Option("--connect", metavar="ENDPOINT", help="use the router there, start none [ZENCELL_CONNECT]"),
]
Json = Annotated[bool, typer.Option("--json", help="one JSON object a line")]
Count = Annotated[int | None, typer.Option("--count", "-n", min=1, metavar="N", help="stop after N")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="PATH=VALUE", help="any value of the cell, as world.count=5; repeatable"),
]
WorldName = Annotated[str | None, typer.Option("--world", metavar="NAME", help="another world, by name or path")]
Seed = Annotated[int | None, typer.Option("--seed", metavar="N", help="of everything random")]
