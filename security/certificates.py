"""A cell's certificate authority, and the folder of certificates, rules and tokens that it makes and renews."""

from __future__ import annotations

import datetime
import errno
import ipaddress
import json
import os
import secrets
import stat
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from common.errors import ConfigError
from common.transport.credentials import (
    ACCESS,
    AUTHORITY,
    OBSERVER,
    OPERATOR,
    ROUTER_NAME,
    common_name,
    require_unwritable,
)
from security.access import Rights, access_control
from security.page_tokens import ROLES, make_token, token_file
from security.validation import certificate_in, hosts_in

CA_NAME = "zencell certificate authority"
NOT_OWN = "is a link or no regular file: writing to it would change another file; remove it"
BACKDATED = datetime.timedelta(minutes=5)  # clocks of two hosts differ
LOCAL = ("localhost", "127.0.0.1", "::1")
ACCESS_HEAD = "// Access rules from the declarations of the services; all else is denied. By `zencell secure init`.\n"


class Authority:
    """Signs certificates. Its key serves no other purpose, and can be stored elsewhere afterwards."""

    def __init__(self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        """Sign with this key."""
        self._certificate, self._key = certificate, key

    @classmethod
    def new(cls, days: int) -> Authority:
        """Return a new authority that is valid for this many days."""
        key = ec.generate_private_key(ec.SECP256R1())
        # OpenSSL finds the authority of a certificate by its name: two that are trusted at a time must differ.
        name = f"{CA_NAME} {secrets.token_hex(4)}"
        return cls(_self_signed(key, days, x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])), key)

    @property
    def until(self) -> datetime.datetime:
        """End of its validity."""
        return self._certificate.not_valid_after_utc

    def prolonged(self, days: int) -> Authority:
        """Return the same authority valid for this many days from now; certificates it signed fit both."""
        return Authority(_self_signed(self._key, days, self._certificate.subject), self._key)

    @classmethod
    def load(cls, certificate: Path, key: Path) -> Authority:
        """Return the authority of two files."""
        private = serialization.load_pem_private_key(key.read_bytes(), password=None)
        if not isinstance(private, ec.EllipticCurvePrivateKey):
            raise ValueError(f"{key} is not an elliptic curve key")
        return cls(x509.load_pem_x509_certificate(certificate.read_bytes()), private)

    def write(self, certificate: Path, key: Path, others: Sequence[x509.Certificate] = ()) -> None:
        """Write both files; only their owner can read the key.

        Args:
            certificate: its file.
            key: file of its key.
            others: certificates of further trusted authorities, written after its own.
        """
        every = [self._certificate, *(each for each in others if each != self._certificate)]
        write_file(certificate, b"".join(each.public_bytes(serialization.Encoding.PEM) for each in every))
        write_secret(key, _key_bytes(self._key))

    def issue(self, name: str, hosts: Sequence[str], days: float, certificate: Path, key: Path) -> None:
        """Write a certificate and its key.

        Args:
            name: common name, which access rules refer to.
            hosts: names and addresses at which its holder listens; empty for a client.
            days: of validity; negative for an expired certificate.
            certificate: its file.
            key: file of its key.
        """
        own = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
        builder = _builder(subject, self._certificate.subject, own.public_key(), days)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        builder = builder.add_extension(
            x509.SubjectAlternativeName([_general_name(host) for host in hosts or [name]]), critical=False
        )
        signed = builder.sign(self._key, hashes.SHA256())
        write_file(certificate, signed.public_bytes(serialization.Encoding.PEM))
        write_secret(key, _key_bytes(own))


def _self_signed(key: ec.EllipticCurvePrivateKey, days: float, name: x509.Name) -> x509.Certificate:
    usage = x509.KeyUsage(
        digital_signature=False, content_commitment=False, key_encipherment=False, data_encipherment=False,
        key_agreement=False, key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
    )
    return (
        _builder(name, name, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .sign(key, hashes.SHA256())
    )


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: float
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    begins, ends = sorted((now - BACKDATED, now + datetime.timedelta(days=days)))
    return (
        x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
        .serial_number(x509.random_serial_number()).not_valid_before(begins).not_valid_after(ends)
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _key_bytes(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def write_secret(path: Path, data: bytes) -> None:
    """Write a file that at no moment another user can read."""
    write_file(path, data, 0o600)


def write_file(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write a file that only this user can change; at no moment it has more permissions than `mode`.

    Raises:
        ConfigError: it is a link, also a hard one, whose target would be overwritten, or not a regular file.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o600)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENXIO):
            raise
        raise ConfigError("DIR", str(path), NOT_OWN) from None
    with os.fdopen(descriptor, "wb") as file:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
            raise ConfigError("DIR", str(path), NOT_OWN)
        os.fchmod(descriptor, mode)  # an existing file may have had others
        file.truncate()
        file.write(data)


def authority_files(place: Path) -> tuple[Path, Path]:
    """Return certificate and key file of the authority."""
    return place / f"{AUTHORITY}.pem", place / f"{AUTHORITY}.key"


def make(
    place: Path, rights: Mapping[str, Mapping[str, Rights]], with_page: Iterable[str], hosts: Sequence[str], days: int,
    *, renew: bool,
) -> int:
    """Make an authority, a certificate for each process, tokens and rules; return the number of certificates.

    Args:
        place: the folder.
        rights: of the processes, by cell and process.
        with_page: cells that have an operator's page.
        hosts: names and addresses at which clients of other hosts reach the router; by default the previous ones.
        days: of validity.
        renew: keep the authority, make everything else again.

    Raises:
        ConfigError: there is no authority to renew, or one already where a new one is to be made.
    """
    certificate, key = authority_files(place)
    if renew and not key.is_file():
        raise ConfigError("--renew", str(place), f"has no {key.name} to sign with")
    if not renew and certificate.exists():
        raise ConfigError("DIR", str(place), "has certificates already: --renew replaces all except the authority")
    place.mkdir(parents=True, exist_ok=True, mode=0o700)
    require_unwritable(place)
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
    write_file(place / ACCESS, text.encode())
    return len(names) + 1


def renew(place: Path, days: int, *, new_authority: bool) -> int:
    """Renew all certificates of the folder; return their number. A new authority is added to the previous one.

    Raises:
        ConfigError: the folder has no key to sign with.
    """
    certificate, key = authority_files(place)
    signer, trusted = _signer(place)
    if new_authority:
        signer = Authority.new(days)
    elif _ends_before(signer, days):
        signer, trusted = signer.prolonged(days), trusted[1:]
    signer.write(certificate, key, others=trusted)  # before the certificates, so that no process meets an untrusted one
    names = [path.stem for path in sorted(place.glob("*.pem")) if path.stem != AUTHORITY]
    for name in sorted(names, key=ROUTER_NAME.__eq__):  # the router's last: it reloads when its own changes
        file = place / f"{name}.pem"
        hosts = hosts_in(certificate_in(file)) if name == ROUTER_NAME else []
        signer.issue(name, hosts, days, file, file.with_suffix(".key"))
    return len(names)


def forget(place: Path) -> int:
    """Remove all previous authorities from the trusted ones; return their number.

    Raises:
        ConfigError: the folder has no key to sign with.
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
    """Return whether an authority would expire before what it signs now."""
    return authority.until < datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days - 1)
