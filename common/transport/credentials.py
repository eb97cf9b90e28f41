"""The folder of certificates of `zencell secure init`: credentials of one process, and when certificates expire."""

from __future__ import annotations

import datetime
import json
import logging
import os
import re
import ssl
import stat
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common.errors import ConfigError

SECURE_VARIABLE = "ZENCELL_SECURE"  # folder of certificates
AUTHORITY, ROUTER_NAME, ACCESS = "ca", "router", "access.json5"
SUPERVISOR, RECORDER = "supervisor", "recorder"  # in each cell, besides its services
OPERATOR, OBSERVER = "operator", "observer"  # tools of people, for all cells
REMEDY = "make it with `zencell secure init DIR --cell CELL`, where CELL is the cell or program to run"

WARNING_TIME, URGENT_TIME = datetime.timedelta(days=30), datetime.timedelta(days=1)  # before a certificate expires
PERIOD = 3600.0  # [s] between two checks of the files
# Validity in a certificate: two UTC times, the second of which is its end. A library for it would stay in the memory
# of every process.
_TIMES = re.compile(rb"\x30.(?:\x17\x0d\d{12}Z|\x18\x0f\d{14}Z)(?:\x17\x0d(\d{12})Z|\x18\x0f(\d{14})Z)", re.DOTALL)
_END = "-----END CERTIFICATE-----"


@dataclass(frozen=True)
class Credentials:
    """Files with which one process authenticates itself."""

    authority: Path
    certificate: Path
    key: Path

    def tls(self, *, listens: bool = False) -> dict[str, Any]:
        """Return the `transport/link/tls` section of a Zenoh configuration; both ends show a certificate."""
        section: dict[str, Any] = {
            "root_ca_certificate": str(self.authority), "enable_mtls": True, "verify_name_on_connect": True,
            "connect_certificate": str(self.certificate), "connect_private_key": str(self.key),
        }
        if listens:
            section |= {"listen_certificate": str(self.certificate), "listen_private_key": str(self.key)}
        return section


def common_name(cell: str, process: str) -> str:
    """Return the name in the certificate of a process, which access rules refer to; that of a tool names no cell."""
    return process if process in (OPERATOR, OBSERVER) else f"{cell}.{process}"


def secure_folder(environ: Mapping[str, str] = os.environ) -> Path | None:
    """Return the folder of certificates to use; None for an open cell."""
    given = environ.get(SECURE_VARIABLE)
    return Path(given) if given else None


def observer_identity(environ: Mapping[str, str] = os.environ) -> str:
    """Return the identity of a tool that only reads: the observer if the folder has one, else the operator."""
    folder = secure_folder(environ)
    return OBSERVER if folder is not None and (folder / f"{OBSERVER}.key").is_file() else OPERATOR


def require_open_cell(what: str, environ: Mapping[str, str] = os.environ) -> None:
    """Return in an open cell.

    Raises:
        ConfigError: the cell is secured: its router drops what a tool publishes.
    """
    if secure_folder(environ) is not None:
        raise ConfigError(what, ..., "is not possible with certificates: only a cell's own services publish")


def credentials_of(name: str, folder: Path) -> Credentials:
    """Return the credentials of a common name.

    Raises:
        ConfigError: a file is missing or unreadable, or other users can read the key.
    """
    found = Credentials(folder / f"{AUTHORITY}.pem", folder / f"{name}.pem", folder / f"{name}.key")
    for file in (found.authority, found.certificate, found.key):
        if not file.is_file():
            raise ConfigError("--secure", str(folder), f"has no {file.name}: {REMEDY}")
        if not os.access(file, os.R_OK):
            raise ConfigError("--secure", str(file), "cannot be read by this user")
    if found.key.stat().st_mode & 0o077:
        raise ConfigError("--secure", str(found.key), "can be read by others: chmod 600 it")
    for path in (folder, found.authority, found.certificate):
        require_unwritable(path)
    return found


def require_unwritable(path: Path) -> None:
    """Return if only its owner can change a file, or replace the files of a folder.

    Raises:
        ConfigError: other users can.
    """
    mode = path.stat().st_mode
    sticky = stat.S_ISDIR(mode) and mode & stat.S_ISVTX  # there, as in volumes of secrets, each replaces only own files
    if mode & 0o022 and not sticky:
        raise ConfigError("--secure", str(path), "can be changed by other users: chmod go-w it, and check its contents")


def require_pair(found: Credentials) -> None:
    """Return if the key fits the certificate and the authority's certificate is readable.

    Raises:
        ConfigError: they do not fit, or one is malformed.
    """
    try:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(found.certificate, found.key)
        context.load_verify_locations(found.authority)
    except (OSError, ValueError) as error:
        raise ConfigError("--secure", str(found.certificate), f"cannot be used with its key: {error}") from None


def read_access(folder: Path) -> dict[str, Any]:
    """Return the access rules of the router.

    Raises:
        ConfigError: the file is missing, malformed, or does not enable access control.
    """
    path = folder / ACCESS
    if path.is_file():
        require_unwritable(folder)
        require_unwritable(path)
    try:
        text = path.read_text(encoding="utf-8")
        lines = [line for line in text.splitlines() if not line.lstrip().startswith("//")]
        rules = json.loads("\n".join(lines))
    except OSError:
        raise ConfigError("--secure", str(folder), f"has no {ACCESS}: {REMEDY}") from None
    except ValueError as error:
        raise ConfigError("--secure", str(path), f"does not parse: {error}") from None
    if not isinstance(rules, dict) or not rules.get("enabled"):
        raise ConfigError("--secure", str(path), "does not control access")
    return rules


def expiry_of(path: Path) -> datetime.datetime | None:
    """Return the end of validity of the first certificate in a file; None if it is unreadable or has none."""
    try:
        text = path.read_text(encoding="ascii")
        first = text[: text.index(_END) + len(_END)]
        found = _TIMES.search(ssl.PEM_cert_to_DER_cert(first[first.index("-----BEGIN"):]))
    except (OSError, ValueError):
        return None
    if found is None:
        return None
    digits = (found[2] or b"20" + found[1]).decode()
    return datetime.datetime.strptime(digits, "%Y%m%d%H%M%S").replace(tzinfo=datetime.UTC)


def expiries_in(folder: Path) -> dict[str, datetime.datetime]:
    """Return the end of validity of each certificate in a folder by its common name; the authority's is `ca`."""
    found = ((path.stem, expiry_of(path)) for path in sorted(folder.glob("*.pem")))
    return {name: until for name, until in found if until is not None}


def expiry_warning(name: str, until: datetime.datetime, now: datetime.datetime) -> tuple[bool, str] | None:
    """Return whether renewing a certificate is urgent, and a warning; None more than 30 days before it expires."""
    left = until - now
    if left > WARNING_TIME:
        return None
    what = "the authority's certificate" if name == AUTHORITY else f"the certificate of {name}"
    if left <= datetime.timedelta(0):
        return True, f"{what} expired on {until:%Y-%m-%d %H:%M} UTC: new connections with it fail"
    hours = left / datetime.timedelta(hours=1)
    return left <= URGENT_TIME, f"{what} expires on {until:%Y-%m-%d %H:%M} UTC, in " + (
        f"{hours / 24:.0f} days" if left > 2 * URGENT_TIME else f"{hours:.0f} hours")


class CertificateMonitor:
    """Warns once for each certificate that expires soon, again when that is urgent, and again when it has expired."""

    def __init__(self, folder: Path | None = None, names: frozenset[str] | None = None) -> None:
        """Monitor a folder.

        Args:
            folder: of certificates; by default that of `ZENCELL_SECURE`.
            names: common names to monitor; by default all in the folder.
        """
        self._folder = folder or secure_folder()
        self._names = names
        self._next = 0.0
        self._reported: dict[str, tuple[bool, bool]] = {}  # urgent and expired, by name

    def log_new(self, log: logging.Logger) -> None:
        """Log new warnings; checks the files at most once an hour."""
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + PERIOD
            for urgent, line in self.new_warnings():
                log.log(logging.ERROR if urgent else logging.WARNING, "%s", line)

    def warnings(self, now: datetime.datetime | None = None) -> list[tuple[bool, str]]:
        """Return all current warnings: whether it is urgent, and a line."""
        return [(urgent, line) for urgent, line, _, _ in self._expiring(now or datetime.datetime.now(datetime.UTC))]

    def new_warnings(self, now: datetime.datetime | None = None) -> list[tuple[bool, str]]:
        """Return the warnings that were not returned before: whether it is urgent, and a line."""
        found = self._expiring(now or datetime.datetime.now(datetime.UTC))
        new = [(urgent, line) for urgent, line, name, expired in found if self._reported.get(name) != (urgent, expired)]
        self._reported = {name: (urgent, expired) for urgent, _, name, expired in found}
        return new

    def _expiring(self, at: datetime.datetime) -> list[tuple[bool, str, str, bool]]:
        """Return urgency, line, name and whether it has expired for each certificate that expires soon."""
        found = []
        for name, until in (expiries_in(self._folder) if self._folder else {}).items():
            if (self._names is None or name in self._names) and (warning := expiry_warning(name, until, at)):
                line = f"{warning[1]}: `zencell secure renew {self._folder}` (docs/security.md)"
                found.append((warning[0], line, name, until <= at))
        return found
