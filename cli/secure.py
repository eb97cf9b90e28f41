"""`zencell secure`: certificates of a cell and its access rules."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from cli import options, verbs
from cli.options import CommandGroup
from common.supervision.multi_host import HostOptions
from common.terminal import echo

app = CommandGroup("Certificates and access rules of a cell's processes.")

DAYS = 365
SHOWN = ("writes", "reads", "answers", "asks", "passes on")

Folder = Annotated[str, typer.Argument(metavar="DIR", help="of the certificates")]
Cells = Annotated[list[str] | None, typer.Option("--cell", metavar="CELL", help="or a program; repeatable; default: "
                                                                               "all of config/cells")]


def _resolved(given: str, overrides: Sequence[str] | None, world: str | None = None) -> tuple[str, list[str]]:
    """Return the cell and its overrides as for `zencell run`: a program replaces the task of its cell."""
    resolved = verbs.before_run(given, list(overrides or ()), world, {})
    return resolved.cell or given, resolved.overrides


@app.command()
def init(
    folder: Folder,
    cells: Cells = None,
    hosts: Annotated[list[str] | None, typer.Option("--host", metavar="NAME", help="name or address at which the "
                                                    "router is reached from elsewhere; repeatable; with --renew the "
                                                    "previous ones if not given")] = None,
    days: Annotated[str, typer.Option("--days", metavar="N", help="for which the certificates are valid")] = str(DAYS),
    overrides: options.Overrides = None,
    renew: Annotated[bool, typer.Option("--renew", help="replace all except the authority")] = False,
) -> None:
    """Create an authority, a certificate for each process, and the access rules of the router."""
    from common.config import load_cell, names_of
    from common.transport.credentials import ACCESS
    from security.access import rights_in
    from security.certificates import authority_files, make
    from security.page_tokens import VIEWER

    valid = options.whole("--days", days, 1)
    assert valid is not None
    loaded = [load_cell(*_resolved(name, overrides)) for name in cells or names_of("cells")]
    with_page = [cell.name for cell in loaded if any(entry.kind == VIEWER for entry in cell.services.values())]
    place = Path(folder)
    made = make(place, {cell.name: rights_in(cell) for cell in loaded}, with_page, hosts or (), valid, renew=renew)
    echo(f"{made} certificates, valid for {valid} days, and {ACCESS} in {folder}")
    echo(f"keep {authority_files(place)[1]} elsewhere: only `secure init --renew` and `secure renew` need it")
    echo(f"next: zencell up {(cells or names_of('cells'))[0]} --secure {folder}")


@app.command("renew")
def renew_(
    folder: Folder,
    days: Annotated[str, typer.Option("--days", metavar="N", help="for which the certificates are valid")] = str(DAYS),
    authority: Annotated[bool, typer.Option("--authority", help="create a new authority; the previous one is trusted, "
                                                                "too, until --forget")] = False,
    forget: Annotated[bool, typer.Option("--forget", help="trust only the newest authority")] = False,
) -> None:
    """Renew all certificates while the cell runs; rules and names stay.

    The router adopts the new files within seconds and closes all links: clients reconnect with their new certificates.
    """
    from common.errors import ConfigError
    from security.certificates import authority_files, renew
    from security.certificates import forget as forget_others

    valid, place = options.whole("--days", days, 1), Path(folder)
    assert valid is not None
    if authority and forget:
        raise ConfigError("--forget", ..., "needs certificates of the new authority on every host first: not with "
                                           "--authority")
    certificate = authority_files(place)[0]
    if forget:
        echo(f"{certificate}: {forget_others(place)} previous authorities are no longer trusted")
        return
    echo(f"{renew(place, valid, new_authority=authority)} certificates, valid for {valid} days, in {folder}; a router "
         "that uses them adopts them within seconds, and all clients reconnect")
    if authority:
        echo(f"the previous authority is still trusted: once every host has its new files, `zencell secure renew "
             f"{folder} --forget`, then copy {certificate.name} to every host again")


@app.command()
def show(folder: Folder, as_json: options.Json = False) -> None:
    """Show what each certificate permits, as the router enforces it, and until when it is valid."""
    from common.errors import ConfigError
    from common.transport.credentials import ROUTER_NAME, read_access
    from security.validation import allowances, certificate_in

    place = Path(folder)
    allowed = allowances(read_access(place))
    for name in sorted(allowed, key=[ROUTER_NAME].__contains__, reverse=True):
        file = place / f"{name}.pem"
        try:
            until = f"{certificate_in(file).not_valid_after_utc:%Y-%m-%d}" if file.is_file() else ""
        except PermissionError:
            raise ConfigError("DIR", str(file), "cannot be read by this user") from None
        rights = {kind: sorted(keys) for kind, keys in allowed.get(name, {}).items() if kind in SHOWN}
        if as_json:
            echo(json.dumps({"name": name, "valid_until": until, **rights}))
            continue
        echo(f"{name}: {f'valid until {until}' if until else 'its certificate is not here'}")
        for kind, keys in rights.items():
            cell = name.partition(".")[0]
            echo(f"  {kind:<8} {', '.join(key.removeprefix(f'{cell}/') for key in keys)}")


@app.command()
def check(
    folder: Folder,
    cells: Cells = None,
    overrides: options.Overrides = None,
    world: options.WorldName = None,
    seed: options.Seed = None,
    only: options.Only = None,
    only_rules: Annotated[bool, typer.Option("--only-rules", hidden=True)] = False,
) -> None:
    """Check that the certificates are valid and that the rules match what the services declare now."""
    from common.config import load_cell, names_of
    from common.errors import ConfigError
    from common.transport.credentials import OPERATOR, RECORDER, ROUTER_NAME, common_name, read_access
    from security.access import rights_in
    from security.preflight import renewal
    from security.validation import require_current, require_valid

    if only and len(cells or ()) != 1:
        raise ConfigError("--only", ",".join(only), "needs the one cell that they are services of: --cell CELL")
    place, number = Path(folder), options.whole("--seed", seed, 0)
    for given in cells or names_of("cells"):
        cell = load_cell(*_resolved(given, overrides, world), world=world, seed=number)
        again = renewal(folder, given)
        rights = rights_in(cell, [entry.name for entry in HostOptions(only=only).part_of(cell).services.values()])
        if not only_rules:
            processes = [process for process in rights if not only or process != RECORDER]
            names = [ROUTER_NAME, *([] if only else [OPERATOR]), *(common_name(cell.name, one) for one in processes)]
            require_valid(place, names, again)
        require_current(place, read_access(place), cell.name, rights, again)
        echo(f"{cell.name}: {len(rights)} processes, certificates and rules match their declarations")


router = CommandGroup("Configuration of a cell's router.")
HEAD = "// A router for work cells, as `zencell up` would start it: zenohd --config THIS_FILE\n"


@router.command()
def config(
    domain: options.Domain = None,
    listen: options.Listen = None,
    link: options.Link = None,
    secure: options.Secure = None,
) -> None:
    """Print the router's configuration as JSON5, for zenohd or the image eclipse/zenoh."""
    from common.supervision.launch import Launch
    from common.transport.credentials import ROUTER_NAME, credentials_of, read_access, secure_folder
    from common.transport.endpoint import (
        DEFAULT_DOMAIN,
        DOMAIN_VARIABLE,
        endpoint_of,
        parse_domain,
        router_settings,
    )
    from security.preflight import choose
    from security.validation import require_valid

    choose(secure)
    given = os.environ.get(DOMAIN_VARIABLE, DEFAULT_DOMAIN) if domain is None else domain
    number = parse_domain(given, DOMAIN_VARIABLE if domain is None else "--domain")
    launch = HostOptions(listen, link).linked(Launch(cell="", domain=number))
    endpoints = launch.listen or (endpoint_of(number),)
    folder = secure_folder()
    if folder is None:
        settings = router_settings(endpoints, links=launch.link)
    else:
        require_valid(folder, [ROUTER_NAME], f"zencell secure init {folder} --renew")
        settings = router_settings(endpoints, credentials_of(ROUTER_NAME, folder), read_access(folder), launch.link)
    echo(HEAD + json.dumps(settings, indent=1))
