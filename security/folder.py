"""The folder of certificates and rules: made once, and made anew while cells run."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from cryptography import x509

from common.errors import ConfigError
from common.transport.credentials import ACCESS, AUTHORITY, OBSERVER, OPERATOR, ROUTER_NAME, common_name
from security.access import Rights, access_control
from security.certificates import Authority, write_secret
from security.checking import certificate_in, hosts_in
from security.page_tokens import ROLES, make_token, token_file

LOCAL = ("localhost", "127.0.0.1", "::1")
ACCESS_HEAD = "// Who may do what, as the services declare it; all else is denied. Made by `zencell secure init`.\n"


def authority_files(place: Path) -> tuple[Path, Path]:
    """Certificate and key of the authority."""
    return place / f"{AUTHORITY}.pem", place / f"{AUTHORITY}.key"


def make(
    place: Path, rights: Mapping[str, Mapping[str, Rights]], with_page: Iterable[str], hosts: Sequence[str], days: int,
    *, renew: bool,
) -> int:
    """Make an authority, a certificate for each process, tokens and rules; how many certificates.

    Args:
        place: the folder.
        rights: of the processes, by cell and process.
        with_page: cells that have an operator's page.
        hosts: names and addresses at which the router is reached from elsewhere; those of before if none are given.
        days: for which the certificates are valid.
        renew: keep the authority, make the rest anew.

    Raises:
        ConfigError: there is none to renew, or one where a new one is to be made.
    """
    certificate, key = authority_files(place)
    if renew and not key.is_file():
        raise ConfigError("--renew", str(place), f"has no {key.name} to sign with")
    if not renew and certificate.exists():
        raise ConfigError("DIR", str(place), "has certificates already: --renew makes all but the authority anew")
    place.mkdir(parents=True, exist_ok=True, mode=0o700)
    authority = Authority.load(certificate, key) if renew else Authority.new(days)
    if not renew:
        authority.write(certificate, key)
    elif _ends_before(authority, days):
        authority = authority.prolonged(days)
        authority.write(certificate, key)
    names = [OPERATOR, OBSERVER, *(common_name(cell, process) for cell, all_ in rights.items() for process in all_)]
    router = place / f"{ROUTER_NAME}.pem"
    reached = hosts or (hosts_in(certificate_in(router)) if renew and router.is_file() else [])
    authority.issue(ROUTER_NAME, list(dict.fromkeys([*LOCAL, *reached])), days, router, router.with_suffix(".key"))
    for name in names:
        authority.issue(name, [], days, place / f"{name}.pem", place / f"{name}.key")
    for cell in with_page:
        for role in ROLES:
            write_secret(token_file(place, cell, role), f"{make_token()}\n".encode())
    text = ACCESS_HEAD + json.dumps(access_control(rights), indent=1) + "\n"
    (place / ACCESS).write_text(text, encoding="utf-8")
    return len(names) + 1


def renew(place: Path, days: int, *, new_authority: bool) -> int:
    """Make the certificates that are there anew; how many. A new authority stands beside the one of before.

    Raises:
        ConfigError: there is nothing to sign with.
    """
    certificate, key = authority_files(place)
    signer, trusted = _signer(place)
    if new_authority:
        signer = Authority.new(days)
    elif _ends_before(signer, days):
        signer, trusted = signer.prolonged(days), trusted[1:]
    signer.write(certificate, key, beside=trusted)  # before those that it signs: nobody meets one that he does not know
    names = [path.stem for path in sorted(place.glob("*.pem")) if path.stem != AUTHORITY]
    for name in sorted(names, key=ROUTER_NAME.__eq__):  # the router's last: it looks for its own
        file = place / f"{name}.pem"
        hosts = hosts_in(certificate_in(file)) if name == ROUTER_NAME else []
        signer.issue(name, hosts, days, file, file.with_suffix(".key"))
    return len(names)


def forget(place: Path) -> int:
    """Trust no authority of before any more; how many those were.

    Raises:
        ConfigError: there is nothing to sign with.
    """
    signer, trusted = _signer(place)
    signer.write(*authority_files(place))
    return len(trusted) - 1


def _signer(place: Path) -> tuple[Authority, list[x509.Certificate]]:
    certificate, key = authority_files(place)
    if not key.is_file():
        raise ConfigError("DIR", str(place), f"has no {key.name} to sign with")
    certificate_in(certificate)
    return Authority.load(certificate, key), x509.load_pem_x509_certificates(certificate.read_bytes())


def _ends_before(authority: Authority, days: int) -> bool:
    """Whether it would end before what it signs now."""
    return authority.until < datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days - 1)
