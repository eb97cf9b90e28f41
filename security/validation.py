"""Validate a folder of certificates against the cell that it is to secure, before any process starts."""

from __future__ import annotations

import contextlib
import datetime
import os
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import NameOID

from common.errors import ConfigError, ZencellError
from common.transport.credentials import credentials_of
from security.access import Rights, access_control

if TYPE_CHECKING:
    from common.config import Cell
    from common.supervision.launch import Launch

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
    for policy in rules["policies"]:
        for name in policy["subjects"]:
            for identity in policy["rules"]:
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


WIRING_TIMEOUT = 120.0  # [s] for the services to declare their keys
PREFIX = "zencell: "  # of the error line of a command


class NotSecured(ZencellError):
    """The certificates do not fit the cell, or its services cannot declare their keys."""

    def __init__(self, message: str, exit_code: int = 2) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def choose(folder: str | None) -> None:
    """Use a folder of certificates, if given, in this process and its children.

    Raises:
        ConfigError: it does not exist.
    """
    from common.transport.credentials import SECURE_VARIABLE

    if folder is None:
        return
    if not folder or not Path(folder).is_dir():
        raise ConfigError("--secure", folder, "is not a folder; make one with `zencell secure init DIR`")
    os.environ[SECURE_VARIABLE] = str(Path(folder).absolute())


def with_near(launch: Launch) -> Launch:
    """Return the launch; in a secured cell its own router also listens at endpoints for services of this host."""
    from common.supervision.launch import free_endpoints
    from common.transport.credentials import secure_folder

    return replace(launch, near=free_endpoints(2)) if secure_folder() and not launch.connect else launch


def require_secured(launch: Launch, cell: Cell) -> None:
    """Return if the cell is open, or if router, supervisor and services of this host have valid certificates and rules.

    Args:
        launch: options of the cell.
        cell: resolved, with the services to start here.

    Raises:
        ConfigError, NotSecured: one line that names the process, the problem and the remedy.
    """
    from common.transport.credentials import ROUTER_NAME, SUPERVISOR, common_name, read_access, secure_folder
    from common.transport.endpoint import is_encrypted

    folder = secure_folder()
    if folder is None:
        return
    if launch.connect and not is_encrypted(launch.connect):
        raise ConfigError("--connect", launch.connect, "is an open endpoint: with --secure it must be tls/HOST:PORT")
    from security.validation import require_valid

    services = [entry.name for entry in cell.services.values()]
    names = [common_name(cell.name, process) for process in (SUPERVISOR, *services)]
    require_valid(folder, names if launch.connect else [ROUTER_NAME, *names], renewal(str(folder), launch.cell))
    if not launch.connect:
        read_access(folder)
        _require_rules(launch, services, folder)


def require_recorder(launch: Launch, cell: Cell) -> None:
    """Return if the cell is open, or if its recorder has a valid certificate.

    Raises:
        ConfigError: it has none.
    """
    from common.transport.credentials import RECORDER, common_name, secure_folder

    folder = secure_folder()
    if folder is not None:
        from security.validation import require_valid

        require_valid(folder, [common_name(cell.name, RECORDER)], renewal(str(folder), launch.cell))


def _require_rules(launch: Launch, services: Sequence[str], folder: Path) -> None:
    # In a child process: the imports of the services would stay in the memory of this one while the cell is up.
    from common.supervision.launch import module_command

    command = [*module_command("cli.main"), "secure", "check", str(folder), "--only-rules", "--cell", launch.cell,
               "--only", ",".join(services)]
    for text in launch.overrides:
        command += ["--set", text]
    if launch.world is not None:
        command += ["--world", launch.world]
    if launch.seed is not None:
        command += ["--seed", str(launch.seed)]
    try:
        done = subprocess.run(
            command, env=launch.environment(), capture_output=True, text=True, timeout=WIRING_TIMEOUT, check=False,
        )
    except subprocess.TimeoutExpired:
        raise NotSecured(f"--secure: the services did not declare their keys within {WIRING_TIMEOUT:g} s") from None
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"`secure check` ended with {done.returncode}"]
        errors = [line.removeprefix(PREFIX) for line in lines if line.startswith(PREFIX)] or lines
        raise NotSecured(errors[-1], done.returncode)


def renewal(folder: str, cell: str) -> str:
    """Return the command line that renews certificates and rules of a cell."""
    from common.config import names_of

    chosen = "" if cell in names_of("cells") else f" --cell {cell}"
    return f"zencell secure init {folder} --renew{chosen}"
