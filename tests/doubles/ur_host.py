"""A process with the controller of an arm of Universal Robots, and commands that inject faults."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from typing import Any

from tests.doubles.ur_controller import ORDERS


class UrHost:
    """A controller at its own loopback address, with the arm at `q` [rad]."""

    def __init__(self, host: str, *options: str, q: str = "0,-1.57,0.5,-1.57,0,0") -> None:
        self.host = host
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.doubles.ur_controller", "--host", host, f"--q={q}", *options],
            stdout=subprocess.PIPE, text=True,
        )
        assert self._process.stdout is not None
        if (line := self._process.stdout.readline()) != "listening\n":
            raise RuntimeError(f"{host} does not start: {line}")
        self._orders = socket.create_connection((host, ORDERS))
        self._file = self._orders.makefile("rw")

    def command(self, order: str = "state") -> dict[str, Any]:
        """Execute a command; return the state of the arm."""
        self._file.write(order + "\n")
        self._file.flush()
        answer: dict[str, Any] = json.loads(self._file.readline())
        return answer

    def __enter__(self) -> UrHost:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._orders.close()
        self._process.kill()
        self._process.communicate()
