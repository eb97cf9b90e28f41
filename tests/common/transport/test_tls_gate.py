"""The gate forwards what clients with a valid certificate send, and no other client can block it."""

import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from common.transport import tls_gate
from common.transport.credentials import Credentials
from common.transport.endpoint import peer_group
from common.transport.inner_certificates import InnerAuthority, name_of
from common.transport.tls_gate import TlsGate
from security.certificates import Authority
from tests.domains import free_port
from tests.security.raw_client import issue

TIMEOUT = 20.0  # [s] only a failing test waits that long
Open = Callable[[], socket.socket]


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Credentials]:
    folder = tmp_path_factory.mktemp("certificates")
    authority = Authority.new(10)
    authority.write(folder / "ca.pem", folder / "ca.key")
    found = {name: issue(authority, name, folder) for name in ("operator", "camera")}
    return found | {"router": issue(authority, "router", folder, hosts=["127.0.0.1"])}


class Echo:
    """A fake router: it sends back all bytes, after the name of the client."""

    def __init__(self, inner: InnerAuthority, router: Credentials) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.verify_mode = ssl.CERT_REQUIRED
        self._context.load_cert_chain(router.certificate, router.key)
        self._context.load_verify_locations(cadata=inner._certificate.decode())
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self.listener.accept()
                threading.Thread(target=self._echo, args=[connection], daemon=True).start()

    def _echo(self, plain: socket.socket) -> None:
        with plain, suppress(OSError), self._context.wrap_socket(plain, server_side=True) as connection:
            if data := connection.recv(65536):
                data = name_of(connection).encode() + data
            while data:
                connection.sendall(data)
                data = connection.recv(65536)


@pytest.fixture
def port(names: dict[str, Credentials]) -> Iterator[int]:
    inner, number = InnerAuthority(names["router"]), free_port()
    with Echo(inner, names["router"]).listener as router, TlsGate([f"tls/127.0.0.1:{number}"]) as gate:
        gate.open(*router.getsockname(), inner)
        yield number


def connect(port: int, credentials: Credentials | None = None) -> ssl.SSLSocket:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    if credentials is not None:
        context.load_cert_chain(credentials.certificate, credentials.key)
    return context.wrap_socket(socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT))


def receive(connection: ssl.SSLSocket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := connection.recv(65536)):
        data += more
    return data


def is_closed(connection: socket.socket) -> bool:
    try:
        while connection.recv(65536):
            pass
        return True
    except (ssl.SSLError, ConnectionError):
        return True


def hello() -> bytes:
    """The first message of a handshake."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    with suppress(ssl.SSLWantReadError):
        ssl.create_default_context().wrap_bio(incoming, outgoing, server_hostname="localhost").do_handshake()
    return outgoing.read()


def test_bytes_are_forwarded_under_the_name_of_the_client(port, names) -> None:
    part, received = bytes(range(256)) * 1_000, b""
    with connect(port, names["camera"]) as connection:
        for number in range(8):  # in turns: one SSL object must not be used by two threads before Python 3.13
            connection.sendall(part)
            received += receive(connection, len(part) + (len("camera") if number == 0 else 0))
    assert received == b"camera" + 8 * part


def test_client_without_a_valid_certificate_is_disconnected(port: int, tmp_path: Path) -> None:
    foreign = issue(Authority.new(10), "operator", tmp_path)
    for credentials in (None, foreign):
        with connect(port, credentials) as connection:
            assert is_closed(connection)
    with socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert is_closed(plain)


@pytest.mark.parametrize("kind", ["silent", "half a hello", "only a hello", "no certificate", "only a handshake"])
def test_clients_that_stay_in_a_stage_keep_no_other_client_out(kind, port, names, monkeypatch) -> None:
    monkeypatch.setattr(tls_gate, "MAX_HANDSHAKES", 16)
    monkeypatch.setattr(tls_gate, "STAGE_SECONDS", 3 * TIMEOUT)  # none of them ends by itself
    first_bytes = {"silent": b"", "half a hello": hello()[:40], "only a hello": hello()}

    def attack() -> socket.socket:
        if kind in first_bytes:
            plain = socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT)
            plain.sendall(first_bytes[kind])
            return plain
        return connect(port, names["camera"] if kind == "only a handshake" else None)

    with ExitStack() as stack:
        open_ = [stack.enter_context(attack()) for _ in range(40)]
        with connect(port, names["operator"]) as connection:
            connection.sendall(b"Zenoh")
            assert receive(connection, 13) == b"operatorZenoh"
        assert all(map(is_closed, open_[:20])), "the oldest ones were ended"


def test_silent_client_is_disconnected_after_a_while(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tls_gate, "STAGE_SECONDS", 0.1)
    with socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT) as plain:
        assert is_closed(plain)


def test_networks_of_ipv6_addresses_count_as_one_peer() -> None:
    assert peer_group("2001:db8:1:2:3::4%eth0") == peer_group("2001:db8:1:2::9") != peer_group("2001:db8:1:3::9")
    assert peer_group("::ffff:10.0.0.1") == peer_group("10.0.0.1") != peer_group("10.0.0.2")


def test_endpoint_in_use_is_named(names: dict[str, Credentials]) -> None:
    endpoint, inner = f"tls/127.0.0.1:{free_port()}", InnerAuthority(names["router"])
    with TlsGate([endpoint]) as first, TlsGate([endpoint]) as second:
        first.open("127.0.0.1", 1, inner)
        with pytest.raises(OSError, match="in use") as taken:
            second.open("127.0.0.1", 1, inner)
        assert taken.value.filename == endpoint
        with pytest.raises(OSError, match="in use"):
            TlsGate([endpoint])
