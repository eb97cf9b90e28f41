"""Who is there: the services that have said that they are ready."""

from __future__ import annotations

import json

import typer

from cli import options

app = typer.Typer(help="Services that are ready.", no_args_is_help=True)


@app.callback()
def node() -> None:
    """Services that are ready."""


@app.command("list")
def list_(
    cell: options.CellName = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
    as_json: options.Json = False,
) -> None:
    """List the services that are ready now, of all cells unless one is named."""
    from cli.inspection import alive, inspect
    from common.errors import NoResponder

    found = inspect(alive, domain=domain, connect=connect)
    shown = [(name, service) for name, service in found if cell in (None, name)]
    if not shown:
        raise NoResponder(f"{cell or '*'}/alive/*")
    for name, service in shown:
        typer.echo(json.dumps({"cell": name, "service": service}) if as_json else f"{name}/{service}")
