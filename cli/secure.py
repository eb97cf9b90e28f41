"""Certificates for a cell's processes, and who may do what."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options

if TYPE_CHECKING:
    from common.config import Cell
    from common.security.access import Rights

app = typer.Typer(help="Certificates for a cell's processes, and who may do what.", no_args_is_help=True)

DAYS = 365
LOCAL = ("localhost", "127.0.0.1", "::1")
ACCESS_HEAD = "// Who may do what, as the services declare it; all else is denied. Made by `zencell secure init`.\n"

Folder = Annotated[str, typer.Argument(metavar="DIR", help="of the certificates")]


@app.callback()
def secure() -> None:
    """Certificates for a cell's processes, and who may do what."""


@app.command()
def init(
    folder: Folder,
    cells: Annotated[list[str] | None, typer.Option("--cell", metavar="CELL", help="all of config/cells if not given; "
                                                    "repeatable")] = None,
    hosts: Annotated[list[str] | None, typer.Option("--host", metavar="NAME", help="name or address at which the "
                                                    "router is reached from elsewhere; repeatable")] = None,
    days: Annotated[str, typer.Option("--days", metavar="N", help="for which the certificates are valid")] = str(DAYS),
    overrides: options.Overrides = None,
    renew: Annotated[bool, typer.Option("--renew", help="keep the authority, make the rest anew")] = False,
) -> None:
    """Make an authority, a certificate for each process, and the router's rules of who may do what."""
    from common.config import load_cell, names_of
    from common.errors import ConfigError
    from common.security.access import access_control
    from common.security.certificates import Authority
    from common.security.credentials import ACCESS, AUTHORITY, OBSERVER, OPERATOR, ROUTER_NAME, common_name

    valid = options.whole("--days", days, 1)
    assert valid is not None
    loaded = [load_cell(name, overrides or ()) for name in cells or names_of("cells")]
    rights = {cell.name: rights_in(cell) for cell in loaded}
    place = Path(folder)
    certificate, key = place / f"{AUTHORITY}.pem", place / f"{AUTHORITY}.key"
    if renew and not key.is_file():
        raise ConfigError("--renew", folder, f"has no {key.name} to sign with")
    if not renew and certificate.exists():
        raise ConfigError("DIR", folder, "has certificates already: --renew makes all but the authority anew")
    place.mkdir(parents=True, exist_ok=True, mode=0o700)
    authority = Authority.load(certificate, key) if renew else Authority.new(valid)
    if not renew:
        authority.write(certificate, key)
    names = [OPERATOR, OBSERVER, *(common_name(cell, process) for cell, all_ in rights.items() for process in all_)]
    authority.issue(ROUTER_NAME, [*LOCAL, *(hosts or ())], valid, place / f"{ROUTER_NAME}.pem",
                    place / f"{ROUTER_NAME}.key")
    for name in names:
        authority.issue(name, [], valid, place / f"{name}.pem", place / f"{name}.key")
    text = ACCESS_HEAD + json.dumps(access_control(rights), indent=1) + "\n"
    (place / ACCESS).write_text(text, encoding="utf-8")
    typer.echo(f"{len(names) + 1} certificates, valid for {valid} days, and {ACCESS} in {folder}")
    typer.echo(f"keep {key} elsewhere: nothing but another `secure init --renew` needs it")
    typer.echo(f"next: zencell up {loaded[0].name} --secure {folder}")


def rights_in(cell: Cell) -> dict[str, Rights]:
    """What each process of a cell may do, found by letting its services declare what they need."""
    from common.security.access import rights_of, rights_of_supervisor
    from common.security.credentials import SUPERVISOR
    from common.transport.wiring import wiring_of

    async def find() -> dict[str, Rights]:
        return {entry.name: rights_of(entry.name, await wiring_of(cell, entry)) for entry in cell.services.values()}

    return {**asyncio.run(find()), SUPERVISOR: rights_of_supervisor()}
