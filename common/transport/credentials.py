"""A folder of certificates, as `zencell secure init` makes it, and what one process takes from it."""

from __future__ import annotations

import json
import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common.errors import ConfigError

SECURE_VARIABLE = "ZENCELL_SECURE"  # folder of certificates, as `zencell secure init` makes it
AUTHORITY, ROUTER_NAME, ACCESS = "ca", "router", "access.json5"
SUPERVISOR, RECORDER = "supervisor", "recorder"  # beside the services of each cell
OPERATOR, OBSERVER = "operator", "observer"  # people's tools, for all cells
REMEDY = "make it with `zencell secure init`"


@dataclass(frozen=True)
class Credentials:
    """Files with which one process proves who it is."""

    authority: Path
    certificate: Path
    key: Path

    def tls(self, *, listens: bool = False) -> dict[str, Any]:
        """The `transport/link/tls` section of a Zenoh configuration: both ends show a certificate."""
        section: dict[str, Any] = {
            "root_ca_certificate": str(self.authority), "enable_mtls": True, "verify_name_on_connect": True,
            "connect_certificate": str(self.certificate), "connect_private_key": str(self.key),
        }
        if listens:
            section |= {"listen_certificate": str(self.certificate), "listen_private_key": str(self.key)}
        return section


def common_name(cell: str, process: str) -> str:
    """The name in the certificate of a process, by which access is controlled; a tool's is that of no one cell."""
    return process if process in (OPERATOR, OBSERVER) else f"{cell}.{process}"


def secure_folder(environ: Mapping[str, str] = os.environ) -> Path | None:
    """The folder of certificates that is to be used; None for an open cell."""
    given = environ.get(SECURE_VARIABLE)
    return Path(given) if given else None


def identity_of_listener(environ: Mapping[str, str] = os.environ) -> str:
    """Whose certificate a tool shows that only listens: the observer's, where there is one."""
    folder = secure_folder(environ)
    return OBSERVER if folder is not None and (folder / f"{OBSERVER}.key").is_file() else OPERATOR


def refuse_to_publish(what: str, environ: Mapping[str, str] = os.environ) -> None:
    """Return in an open cell.

    Raises:
        ConfigError: the cell is secured, where the router would take nothing that a tool publishes.
    """
    if secure_folder(environ) is not None:
        raise ConfigError(what, ..., "is not possible with certificates: only a cell's own services publish")


def credentials_of(name: str, folder: Path) -> Credentials:
    """The credentials of a common name.

    Raises:
        ConfigError: the folder has none for it, or its key can be read by others.
    """
    found = Credentials(folder / f"{AUTHORITY}.pem", folder / f"{name}.pem", folder / f"{name}.key")
    for file in (found.authority, found.certificate, found.key):
        if not file.is_file():
            raise ConfigError("--secure", str(folder), f"has no {file.name}: {REMEDY}")
        if not os.access(file, os.R_OK):
            raise ConfigError("--secure", str(file), "cannot be read by this user")
    if found.key.stat().st_mode & 0o077:
        raise ConfigError("--secure", str(found.key), "can be read by others: chmod 600 it")
    return found


def require_pair(found: Credentials) -> None:
    """Return when key and certificate belong together, and the authority's can be read.

    Raises:
        ConfigError: they do not.
    """
    try:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(found.certificate, found.key)
        context.load_verify_locations(found.authority)
    except (OSError, ValueError) as error:
        raise ConfigError("--secure", str(found.certificate), f"cannot be used with its key: {error}") from None


def read_access(folder: Path) -> dict[str, Any]:
    """The router's rules of who may do what.

    Raises:
        ConfigError: there are none, or they cannot be read.
    """
    path = folder / ACCESS
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
