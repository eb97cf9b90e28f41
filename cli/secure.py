"""Certificates for a cell's processes, and who may do what."""

from __future__ import annotations

import asyncio
import datetime
import json
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options
from cli.viewing import VIEWER
from common.errors import ZencellError
from common.graph.wired import Unwired
from common.supervision.share import Share
from common.terminal import echo

if TYPE_CHECKING:
    from common.config import Cell
    from common.security.access import Rights

app = typer.Typer(help="Certificates for a cell's processes, and who may do what.", no_args_is_help=True)

DAYS = 365
SHOWN = ("writes", "reads", "answers", "asks", "passes on")
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
                                                    "router is reached from elsewhere; repeatable; with --renew those "
                                                    "of before if not given")] = None,
    days: Annotated[str, typer.Option("--days", metavar="N", help="for which the certificates are valid")] = str(DAYS),
    overrides: options.Overrides = None,
    renew: Annotated[bool, typer.Option("--renew", help="keep the authority, make the rest anew")] = False,
) -> None:
    """Make an authority, a certificate for each process, and the router's rules of who may do what."""
    from common.config import load_cell, names_of
    from common.errors import ConfigError
    from common.security.access import access_control
    from common.security.certificates import Authority, write_secret
    from common.security.checking import certificate_in, hosts_in
    from common.transport.credentials import ACCESS, AUTHORITY, OBSERVER, OPERATOR, ROUTER_NAME, common_name
    from common.viewer.access import ROLES, make_token, token_file

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
    elif authority.until < datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=valid - 1):
        authority = authority.prolonged(valid)  # else it would end before what it signs now
        authority.write(certificate, key)
    names = [OPERATOR, OBSERVER, *(common_name(cell, process) for cell, all_ in rights.items() for process in all_)]
    router = place / f"{ROUTER_NAME}.pem"
    reached = hosts or (hosts_in(certificate_in(router)) if renew and router.is_file() else [])
    authority.issue(ROUTER_NAME, list(dict.fromkeys([*LOCAL, *reached])), valid, router, router.with_suffix(".key"))
    for name in names:
        authority.issue(name, [], valid, place / f"{name}.pem", place / f"{name}.key")
    for cell in loaded:
        for role in ROLES if any(entry.kind == VIEWER for entry in cell.services.values()) else ():
            write_secret(token_file(place, cell.name, role), f"{make_token()}\n".encode())
    text = ACCESS_HEAD + json.dumps(access_control(rights), indent=1) + "\n"
    (place / ACCESS).write_text(text, encoding="utf-8")
    echo(f"{len(names) + 1} certificates, valid for {valid} days, and {ACCESS} in {folder}")
    echo(f"keep {key} elsewhere: nothing but another `secure init --renew` needs it")
    echo(f"next: zencell up {(cells or names_of('cells'))[0]} --secure {folder}")


@app.command("renew")
def renew_(
    folder: Folder,
    days: Annotated[str, typer.Option("--days", metavar="N", help="for which the certificates are valid")] = str(DAYS),
    authority: Annotated[bool, typer.Option("--authority", help="with a new authority beside the one of before, which "
                                                                "is trusted until --forget")] = False,
    forget: Annotated[bool, typer.Option("--forget", help="trust no authority of before any more")] = False,
) -> None:
    """Make the certificates that are there anew, while the cell runs; rules and names stay.

    The router takes what is new within seconds and has everybody connect anew, each with what is new of his own.
    """
    from cryptography import x509

    from common.errors import ConfigError
    from common.security.certificates import Authority
    from common.security.checking import certificate_in, hosts_in
    from common.transport.credentials import AUTHORITY, ROUTER_NAME

    valid, place = options.whole("--days", days, 1), Path(folder)
    assert valid is not None
    certificate, key = place / f"{AUTHORITY}.pem", place / f"{AUTHORITY}.key"
    if authority and forget:
        raise ConfigError("--forget", ..., "comes when everybody has a certificate of the new authority: apart from "
                                           "--authority")
    if not key.is_file():
        raise ConfigError("DIR", folder, f"has no {key.name} to sign with")
    certificate_in(certificate)
    trusted = x509.load_pem_x509_certificates(certificate.read_bytes())
    signer = Authority.load(certificate, key)
    if forget:
        signer.write(certificate, key)
        echo(f"{certificate}: {len(trusted) - 1} authorities of before are trusted no more")
        return
    if authority:
        signer = Authority.new(valid)
    elif signer.until < datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=valid - 1):
        signer, trusted = signer.prolonged(valid), trusted[1:]
    signer.write(certificate, key, beside=trusted)  # before those that it signs: nobody meets one that he does not know
    names = [path.stem for path in sorted(place.glob("*.pem")) if path.stem != AUTHORITY]
    for name in sorted(names, key=ROUTER_NAME.__eq__):  # the router's last: it looks for its own
        file = place / f"{name}.pem"
        hosts = hosts_in(certificate_in(file)) if name == ROUTER_NAME else []
        signer.issue(name, hosts, valid, file, file.with_suffix(".key"))
    echo(f"{len(names)} certificates, valid for {valid} days, in {folder}; a router that uses them shows them within "
         "seconds, and has everybody connect anew")
    if authority:
        echo(f"the authority of before is trusted too: when every host has its new files, `zencell secure renew "
             f"{folder} --forget`, and {certificate.name} to every host once more")


@app.command()
def show(folder: Folder, as_json: options.Json = False) -> None:
    """Show who may do what, as the router enforces it, and until when each certificate is valid."""
    from common.errors import ConfigError
    from common.security.checking import allowances, certificate_in
    from common.transport.credentials import ROUTER_NAME, read_access

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
    cells: Annotated[list[str] | None, typer.Option("--cell", metavar="CELL", help="all of config/cells if not given; "
                                                    "repeatable")] = None,
    overrides: options.Overrides = None,
    world: options.WorldName = None,
    seed: options.Seed = None,
    only: options.Only = None,
    only_rules: Annotated[bool, typer.Option("--only-rules", hidden=True)] = False,
) -> None:
    """Say whether the certificates are valid, and the rules those that the cells' services need now."""
    from common.config import load_cell, names_of
    from common.errors import ConfigError
    from common.security.checking import require_current, require_valid
    from common.transport.credentials import OPERATOR, RECORDER, ROUTER_NAME, common_name, read_access

    if only and len(cells or ()) != 1:
        raise ConfigError("--only", ",".join(only), "needs the one cell that they are services of: --cell CELL")
    place, number = Path(folder), options.whole("--seed", seed, 0)
    for given in cells or names_of("cells"):
        cell = load_cell(given, overrides or (), world=world, seed=number)
        again = renewal(folder, given)
        rights = rights_in(cell, [entry.name for entry in Share(only=only).part_of(cell).services.values()])
        if not only_rules:
            processes = [process for process in rights if not only or process != RECORDER]
            names = [ROUTER_NAME, *([] if only else [OPERATOR]), *(common_name(cell.name, one) for one in processes)]
            require_valid(place, names, again)
        require_current(place, read_access(place), cell.name, rights, again)
        echo(f"{cell.name}: {len(rights)} processes, certificates and rules are as they need them")


def renewal(folder: str, cell: str) -> str:
    """The command line that makes certificates and rules for a cell anew."""
    from common.config import names_of

    chosen = "" if cell in names_of("cells") else f" --cell {cell}"
    return f"zencell secure init {folder} --renew{chosen}"


def rights_in(cell: Cell, names: Collection[str] | None = None) -> dict[str, Rights]:
    """What each process of a cell may do, found by letting its services declare what they need.

    Args:
        cell: resolved; the whole of it, because what a service declares may depend on who else is there.
        names: of the services that are looked at; all when not given.

    Raises:
        ConfigError: one of them cannot be configured so, or two of them write or serve one key.
        Unwired: one of them does not get so far.
    """
    from common.process.wiring import Wiring, require_one_owner, wiring_of
    from common.security.access import rights_of, rights_of_recorder, rights_of_supervisor
    from common.supervision.launch import require_modules
    from common.transport.credentials import RECORDER, SUPERVISOR

    require_modules(cell)
    apart = cell.model_copy(update={"services": {
        # The page listens while it is looked at: where nobody else does, for the cell may be up.
        key: entry.model_copy(update={"parameters": {**entry.parameters, "host": "127.0.0.1", "port": 0}})
        if entry.kind == VIEWER else entry for key, entry in cell.services.items()
    }})

    async def find() -> dict[str, Wiring]:
        found = {}
        for entry in apart.services.values():
            if names is not None and entry.name not in names:
                continue
            try:
                found[entry.name] = await wiring_of(apart, entry)
            except ZencellError:
                raise
            except Exception as error:  # whatever a service does that cannot run so
                raise Unwired(entry.name, error) from error
        return found

    wirings = asyncio.run(find())
    require_one_owner(wirings)
    rights = {name: rights_of(name, declared) for name, declared in wirings.items()}
    return {**rights, SUPERVISOR: rights_of_supervisor(), RECORDER: rights_of_recorder(rights.values())}
