"""The gate forwards clients that start a TLS handshake at once, byte for byte, and no others."""

import socket
import threading
from collections.abc import Iterator
from contextlib import suppress

import pytest

from common.transport.tls_gate import MAX_PER_ADDRESS, TlsGate

HELLO = b"\x16\x03\x01\x00\x20\x01"
TIMEOUT = 20.0  # [s] only a failing test waits that long


class Echo:
    """A fake router that sends back all bytes."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.accepted = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self.listener.accept()
                self.accepted += 1
                threading.Thread(target=self._echo, args=[connection], daemon=True).start()

    def _echo(self, connection: socket.socket) -> None:
        with connection, suppress(OSError):
            while data := connection.recv(65536):
                connection.sendall(data)


@pytest.fixture
def echo() -> Iterator[Echo]:
    router = Echo()
    with router.listener:
        yield router


@pytest.fixture
def port(echo: Echo) -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        number = int(probe.getsockname()[1])
    with TlsGate([f"tls/127.0.0.1:{number}"]) as gate:
        gate.open(*echo.listener.getsockname())
        yield number


def connect(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT)


def receive(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := connection.recv(65536)):
        data += more
    return data


def test_handshake_is_forwarded_byte_for_byte_until_the_end_of_the_stream(port: int) -> None:
    data = HELLO + bytes(range(256)) * 40_000
    with connect(port) as connection:
        threading.Thread(target=connection.sendall, args=[data], daemon=True).start()
        assert receive(connection, len(data)) == data
        connection.shutdown(socket.SHUT_WR)
        assert connection.recv(1) == b""


def test_client_without_a_handshake_is_disconnected(port: int, echo: Echo, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.transport.tls_gate.HELLO_SECONDS", 0.1)
    for first_bytes in (b"", b"GET / HTTP/1.1\r\n", b"\x16\x03\x01\x00\x20\x02", b"\x16\x03"):
        with connect(port) as connection:
            connection.sendall(first_bytes)
            with suppress(ConnectionResetError):
                assert connection.recv(1) == b""
    assert echo.accepted == 0


def test_silent_clients_keep_no_other_client_out(port: int, echo: Echo) -> None:
    silent = [connect(port) for _ in range(4 * MAX_PER_ADDRESS)]
    with connect(port) as connection:
        connection.settimeout(3.0)
        connection.sendall(HELLO)
        assert receive(connection, len(HELLO)) == HELLO
    for each in silent:
        with each, suppress(ConnectionResetError):
            assert each.recv(1) == b""
    assert echo.accepted == 1


def test_endpoint_in_use_is_named(echo: Echo) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        endpoint = f"tls/127.0.0.1:{probe.getsockname()[1]}"
    with TlsGate([endpoint]) as first, TlsGate([endpoint]) as second:
        first.open(*echo.listener.getsockname())
        with pytest.raises(OSError, match="in use") as taken:
            second.open(*echo.listener.getsockname())
        assert taken.value.filename == endpoint
    with pytest.raises(OSError, match="in use"):
        TlsGate([f"tls/127.0.0.1:{echo.listener.getsockname()[1]}"])
