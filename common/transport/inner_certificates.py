"""Certificates with which the TLS gate presents the clients that it has authenticated to the router behind it."""

from __future__ import annotations

import base64
import datetime
import ssl
import tempfile
from typing import Any

from common.errors import ConfigError
from common.transport.credentials import Credentials, require_pair


class InnerAuthority:
    """An authority that exists only in the memory of the router's process, and signs the names of proven clients."""

    def __init__(self, router: Credentials) -> None:
        """Prepare to authenticate clients as the router does.

        Raises:
            ConfigError: the router's files cannot be used.
        """
        from cryptography.hazmat.primitives.asymmetric import ec  # only in a secured router: it takes 10 MB

        require_pair(router)
        self.server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self.server.minimum_version = ssl.TLSVersion.TLSv1_3
        self.server.verify_mode = ssl.CERT_REQUIRED
        self.server.num_tickets = 0
        self.server.load_cert_chain(router.certificate, router.key)
        self.server.load_verify_locations(router.authority)
        self._router = router
        self._outer = router.authority.read_bytes()
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._certificate = self._sign("zencell TLS gate", is_authority=True)
        self._clients: dict[str, ssl.SSLContext] = {}

    def tls(self, *, listens: bool = False) -> dict[str, Any]:
        """Return the section as of the router's `Credentials`, with this authority as a further one that it trusts."""
        trusted = base64.b64encode(self._outer + b"\n" + self._certificate).decode()
        section = self._router.tls(listens=listens) | {"root_ca_certificate_base64": trusted}
        del section["root_ca_certificate"]
        return section

    def client(self, name: str) -> ssl.SSLContext:
        """Return the context of a connection to the router on behalf of the client with this common name."""
        from cryptography.hazmat.primitives import serialization

        if name not in self._clients:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            context.minimum_version = ssl.TLSVersion.TLSv1_3
            context.check_hostname = False  # an address of this process; its certificate is checked
            context.load_verify_locations(cadata=self._outer.decode("ascii"))
            pem, secret = serialization.Encoding.PEM, serialization.NoEncryption()
            with tempfile.NamedTemporaryFile() as file:  # which only this user can read
                file.write(self._key.private_bytes(pem, serialization.PrivateFormat.PKCS8, secret))
                file.write(self._sign(name, is_authority=False))
                file.flush()
                context.load_cert_chain(file.name)
            self._clients[name] = context
        return self._clients[name]

    def _sign(self, name: str, *, is_authority: bool) -> bytes:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes, serialization
        from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

        subject, issuer = (x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, each)])
                           for each in (name, "zencell TLS gate"))
        now, life = datetime.datetime.now(datetime.UTC), datetime.timedelta(days=3650)  # longer than the process runs
        return (
            x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(self._key.public_key())
            .serial_number(x509.random_serial_number()).not_valid_before(now - life).not_valid_after(now + life)
            .add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH]), critical=False)
            .sign(self._key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
        )


def name_of(connection: ssl.SSLSocket) -> str:
    """Return the common name that access rules refer to: the first one of an authenticated client.

    Raises:
        ConfigError: its certificate has none.
    """
    subject: Any = (connection.getpeercert() or {}).get("subject", ())
    names = [value for part in subject for key, value in part if key == "commonName"]
    if not names:
        raise ConfigError("certificate", ..., "has no common name")
    return str(names[0])
