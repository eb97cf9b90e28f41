"""A test host that runs the controller of an arm, and tells it how to misbehave."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from typing import Any

from tests.doubles.ur_controller import ORDERS


class UrHost:
    """A process of its own at an address of its own; `q` where the arm stands [rad]."""

    def __init__(self, host: str, *options: str, q: str = "0,-1.57,0.5,-1.57,0,0") -> None:
        self.host = host
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.doubles.ur_controller", "--host", host, f"--q={q}", *options],
            stdout=subprocess.PIPE, text=True,
        )
        assert self._process.stdout is not None
        said = self._process.stdout.readline()
        if said != "listening\n":
            raise RuntimeError(f"{host}: {said}: see above")
        self._orders = socket.create_connection((host, ORDERS))
        self._file = self._orders.makefile("rw")

    def command(self, order: str = "state") -> dict[str, Any]:
        """Give an order; how the arm is."""
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
