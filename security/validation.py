"""Validate a folder of certificates against the cell that it is to secure, before any process starts."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import NameOID

from common.errors import ConfigError
from common.transport.credentials import credentials_of
from security.access import Rights, access_control

FIELD = "--secure"
REMEDY = "create it again with `zencell secure init`"


def require_valid(folder: Path, names: Iterable[str], renew: str, now: datetime.datetime | None = None) -> None:
    """Return if each common name has a valid certificate of the authority, and its key.

    Args:
        folder: of the certificates.
        names: of the processes to start.
        renew: command line that renews them.
        now: time of the check; by default the current time.

    Raises:
        ConfigError: names the first that is missing, is not of this authority, or has expired.
    """
    if not folder.is_dir():
        raise ConfigError(FIELD, str(folder), "is not a folder; make one with `zencell secure init DIR`")
    at = now or datetime.datetime.now(datetime.UTC)
    authorities: list[x509.Certificate] = []
    for name in names:
        own = credentials_of(name, folder)
        if not authorities:
            certificate_in(own.authority)
            authorities = x509.load_pem_x509_certificates(own.authority.read_bytes())
            _require_unexpired(own.authority, authorities[0], at, f"`{renew}`")
        certificate = certificate_in(own.certificate)
        _require_unexpired(own.certificate, certificate, at, f"`{renew}`")
        try:
            _require_issued(certificate, authorities)
            key = serialization.load_pem_private_key(own.key.read_bytes(), password=None)
        except (InvalidSignature, ValueError, TypeError):
            raise ConfigError(FIELD, str(own.certificate), f"is not of {own.authority.name}: `{renew}`") from None
        if key.public_key() != certificate.public_key() or common_name_in(certificate) != name:
            raise ConfigError(FIELD, str(own.certificate), f"is not that of {own.key.name}: `{renew}`")


def _require_issued(certificate: x509.Certificate, authorities: Iterable[x509.Certificate]) -> None:
    for authority in authorities:
        with contextlib.suppress(InvalidSignature, ValueError, TypeError):
            certificate.verify_directly_issued_by(authority)
            return
    raise InvalidSignature


def require_current(
    folder: Path, rules: Mapping[str, Any], cell: str, rights: Mapping[str, Rights], renew: str
) -> None:
    """Return if the rules allow each process exactly what it declares.

    Args:
        folder: of the rules.
        rules: `access_control` section for the router.
        cell: name of the cell.
        rights: current ones of each of its processes.
        renew: command line that renews the rules.

    Raises:
        ConfigError: names the first process without rules or with different ones, and the difference.
    """
    wanted = allowances(access_control({cell: rights}))
    given = allowances(rules)
    for name, allowed in wanted.items():
        if name not in given:
            raise ConfigError(FIELD, str(folder), f"has no rules for {name}: `{renew}`")
        differences = [*_differences(allowed, given[name])]
        if differences:
            raise ConfigError(FIELD, str(folder), f"has other rules for {name} than it declares now "
                                                  f"({differences[0]}): `{renew}`")


def allowances(rules: Mapping[str, Any]) -> dict[str, dict[str, set[str]]]:
    """Return what each common name may do: key expressions by the kind of rule, such as `reads`."""
    by_id = {rule["id"]: rule for rule in rules["rules"]}
    found: dict[str, dict[str, set[str]]] = {}
    for granted in rules["policies"]:
        for name in granted["subjects"]:
            for identity in granted["rules"]:
                kind = identity.removeprefix(f"{name} ")
                found.setdefault(name, {}).setdefault(kind, set()).update(by_id[identity]["key_exprs"])
    return found


def common_name_in(certificate: x509.Certificate) -> str:
    """Return the common name of a certificate."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def hosts_in(certificate: x509.Certificate) -> list[str]:
    """Return the names and addresses at which the holder of a certificate listens."""
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    return [str(name.value) for name in found if isinstance(name, (x509.DNSName, x509.IPAddress))]


def certificate_in(path: Path) -> x509.Certificate:
    """Return the certificate of a file.

    Raises:
        ConfigError: the file has none.
    """
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError:
        raise ConfigError(FIELD, str(path), f"is not a certificate: {REMEDY}") from None


def _require_unexpired(path: Path, certificate: x509.Certificate, now: datetime.datetime, remedy: str) -> None:
    until, since = certificate.not_valid_after_utc, certificate.not_valid_before_utc
    if now > until:
        raise ConfigError(FIELD, str(path), f"expired on {until:%Y-%m-%d}: {remedy}")
    if now < since:
        raise ConfigError(FIELD, str(path), f"is valid from {since:%Y-%m-%d %H:%M} UTC on: check the clock here")


def _differences(wanted: Mapping[str, set[str]], given: Mapping[str, set[str]]) -> Iterable[str]:
    for kind in sorted({*wanted, *given}):
        now, before = wanted.get(kind, set()), given.get(kind, set())
        for key in sorted(now - before):
            yield f"{kind}: {key} is not allowed"
        for key in sorted(before - now):
            yield f"{kind}: {key} is allowed and not needed"
