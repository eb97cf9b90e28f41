"""A certificate authority of a cell's own, and a certificate for each of its processes."""

from __future__ import annotations

import datetime
import ipaddress
import os
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

CA_NAME = "zencell certificate authority"
BACKDATED = datetime.timedelta(minutes=5)  # clocks of two hosts never agree to the second


class Authority:
    """Signs certificates. Its own key is needed for nothing else and can be kept elsewhere afterwards."""

    def __init__(self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        """Sign with this key."""
        self._certificate, self._key = certificate, key

    @classmethod
    def new(cls, days: int) -> Authority:
        """An authority that is trusted for so many days."""
        key = ec.generate_private_key(ec.SECP256R1())
        return cls(_signed_by_itself(key, days), key)

    @property
    def until(self) -> datetime.datetime:
        """The end of its time."""
        return self._certificate.not_valid_after_utc

    def prolonged(self, days: int) -> Authority:
        """The same with a certificate for so many days from now: what it has signed is valid under both."""
        return Authority(_signed_by_itself(self._key, days), self._key)

    @classmethod
    def load(cls, certificate: Path, key: Path) -> Authority:
        """The authority that was written to two files."""
        private = serialization.load_pem_private_key(key.read_bytes(), password=None)
        if not isinstance(private, ec.EllipticCurvePrivateKey):
            raise ValueError(f"{key} is not an elliptic curve key")
        return cls(x509.load_pem_x509_certificate(certificate.read_bytes()), private)

    def write(self, certificate: Path, key: Path, beside: Sequence[x509.Certificate] = ()) -> None:
        """Write both; the key for its owner's eyes only.

        Args:
            certificate: file for it.
            key: file for its key.
            beside: certificates of authorities that are trusted as well, after its own.
        """
        every = [self._certificate, *(each for each in beside if each != self._certificate)]
        certificate.write_bytes(b"".join(each.public_bytes(serialization.Encoding.PEM) for each in every))
        write_secret(key, _key_bytes(self._key))

    def issue(self, name: str, hosts: Sequence[str], days: float, certificate: Path, key: Path) -> None:
        """Write a certificate and its key.

        Args:
            name: common name, by which access is controlled.
            hosts: names and addresses at which its holder is reached; empty for one who only connects.
            days: for which it is valid; negative for one that has run out.
            certificate: file for it.
            key: file for its key.
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
        certificate.write_bytes(signed.public_bytes(serialization.Encoding.PEM))
        write_secret(key, _key_bytes(own))


def _signed_by_itself(key: ec.EllipticCurvePrivateKey, days: float) -> x509.Certificate:
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, CA_NAME)])
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
    """Write a file that never, not even for a moment, anybody but its owner can read."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        os.fchmod(file.fileno(), 0o600)  # one that was there before may have been open to more
        file.write(data)
