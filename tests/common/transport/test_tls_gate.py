"""The front passes on who begins a handshake at once, byte for byte, and nobody else."""

import socket
import threading
from collections.abc import Iterator
from contextlib import suppress

import pytest

from common.transport.tls_gate import MAX_PER_ADDRESS, TlsGate

HELLO = b"\x16\x03\x01\x00\x20\x01"
PATIENCE = 20.0  # [s] only ever waited for by a test that fails


class Echo:
    """A router: answers with what it hears, once it heard 6 bytes."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.came = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                made, _ = self.listener.accept()
                self.came += 1
                threading.Thread(target=self._echo, args=[made], daemon=True).start()

    def _echo(self, made: socket.socket) -> None:
        with made, suppress(OSError):
            while data := made.recv(65536):
                made.sendall(data)


@pytest.fixture
def echo() -> Iterator[Echo]:
    made = Echo()
    with made.listener:
        yield made


@pytest.fixture
def port(echo: Echo) -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        number = int(probe.getsockname()[1])
    with TlsGate([f"tls/127.0.0.1:{number}"]) as front:
        front.open(*echo.listener.getsockname())
        yield number


def joined(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=PATIENCE)


def heard(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := connection.recv(65536)):
        data += more
    return data


def test_what_begins_a_handshake_is_passed_on_byte_for_byte(port: int) -> None:
    sent = HELLO + bytes(range(256)) * 40_000
    with joined(port) as connection:
        threading.Thread(target=connection.sendall, args=[sent], daemon=True).start()
        assert heard(connection, len(sent)) == sent


@pytest.mark.parametrize("said", [b"", b"GET / HTTP/1.1\r\n", b"\x16\x03\x01\x00\x20\x02", b"\x16\x03"])
@pytest.mark.slow
def test_what_does_not_is_ended(port: int, echo: Echo, said: bytes) -> None:
    with joined(port) as connection:
        connection.sendall(said)
        with suppress(ConnectionResetError):
            assert connection.recv(1) == b""
    assert echo.came == 0


def test_an_end_is_passed_on_both_ways(port: int, echo: Echo) -> None:
    with joined(port) as connection:
        connection.sendall(HELLO)
        assert heard(connection, len(HELLO)) == HELLO
        connection.shutdown(socket.SHUT_WR)
        assert connection.recv(1) == b""


def test_silent_ones_do_not_keep_out_who_speaks(port: int, echo: Echo) -> None:
    silent = [joined(port) for _ in range(4 * MAX_PER_ADDRESS)]
    with joined(port) as connection:
        connection.settimeout(3.0)
        connection.sendall(HELLO)
        assert heard(connection, len(HELLO)) == HELLO
    for each in silent:
        with each, suppress(ConnectionResetError):
            assert each.recv(1) == b""
    assert echo.came == 1


def test_endpoint_that_somebody_else_has_by_now_is_named(echo: Echo) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        endpoint = f"tls/127.0.0.1:{probe.getsockname()[1]}"
    with TlsGate([endpoint]) as first, TlsGate([endpoint]) as second:
        first.open(*echo.listener.getsockname())
        with pytest.raises(OSError, match="in use") as taken:
            second.open(*echo.listener.getsockname())
        assert taken.value.filename == endpoint
    with echo.listener, pytest.raises(OSError, match="in use") as taken:
        TlsGate([f"tls/127.0.0.1:{echo.listener.getsockname()[1]}"])
