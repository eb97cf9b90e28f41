"""Double of Robotiq's program on an arm's controller: registers, and fingers that move and meet objects."""

from __future__ import annotations

import contextlib
import socket
import socketserver
import threading
import time

OPEN, CLOSED = 3, 228  # counts at the ends of their travel
SPEED = 400.0  # counts a second at SPE 255, and 50 at 0


class Gripper:
    """Fingers in counts; `thing` is the count at which they meet an object."""

    def __init__(self) -> None:
        self.registers = {"ACT": 1, "STA": 3, "GTO": 0, "POS": OPEN, "SPE": 255, "FOR": 255, "FLT": 0}
        self.thing: int | None = None
        self.answers = b"ack"  # some versions append a line end
        self._start, self._from, self._to, self._reached, self._met = 0.0, OPEN, OPEN, OPEN, False
        self._lock = threading.Lock()

    def answer(self, line: str) -> bytes:
        """Return the reply to a line."""
        words = line.split()
        with self._lock:
            self._move()
            if words[0] == "GET":
                return f"{words[1]} {self._value(words[1])}\n".encode()
            for name, value in zip(words[1::2], words[2::2], strict=True):
                self.registers[name] = int(value)
                if name == "POS":
                    self._start, self._from = time.monotonic(), self._reached
                    self._to = min(max(int(value), OPEN), CLOSED)
        return self.answers

    def _move(self) -> None:
        rate = 50 + (SPEED - 50) * self.registers["SPE"] / 255
        distance = (time.monotonic() - self._start) * rate
        way = self._to - self._from
        self._reached = self._to if distance >= abs(way) else self._from + round(distance if way > 0 else -distance)
        self._met = self.thing is not None and way > 0 and self._reached >= self.thing
        if self._met and self.thing is not None:
            self._reached = self.thing

    def _value(self, name: str) -> int:
        if name == "POS":
            return self._reached
        if name == "OBJ":
            return 2 if self._met else 3 if self._reached == self._to else 0
        return self.registers[name]


class RobotiqHost:
    """The port of the gripper."""

    def __init__(self, port: int = 0) -> None:
        self.gripper = gripper = Gripper()
        self._connections: set[socket.socket] = set()
        connections = self._connections

        class Lines(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                connections.add(self.connection)
                with contextlib.suppress(OSError):
                    for line in self.rfile:
                        self.wfile.write(gripper.answer(line.decode()))

        class Server(socketserver.ThreadingTCPServer):
            allow_reuse_address, daemon_threads = True, True

        self._server = Server(("127.0.0.1", port), Lines)
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def __enter__(self) -> RobotiqHost:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        for connection in self._connections:
            with contextlib.suppress(OSError):  # already closed
                connection.shutdown(socket.SHUT_RDWR)
        self._server.server_close()
