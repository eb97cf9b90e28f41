"""franka-sim as a test host: the vendor's protocol with a MuJoCo arm, in the environment of `make franka-sim`."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-franka-sim" / "bin" / "python"
HAND_PORT = 1338  # part of the protocol: one host at a time
TIMEOUT = 60.0  # [s]


class FrankaHost:
    """A controller at 127.0.0.1 with options of franka-sim's server."""

    def __init__(self, *options: str) -> None:
        self._folder, self._options = tempfile.TemporaryDirectory(), options
        folder = Path(self._folder.name)
        subprocess.run([PYTHON, ROOT / "tests" / "doubles" / "franka_model.py", folder], check=True)
        self._models = {"FR3_MJCF": str(folder / "fr3.xml"), "FRANKA_HAND_MJCF": str(folder / "hand.xml")}
        self.log = folder / "log"
        self.boot()

    def boot(self) -> None:
        """Start the controller with the arm at its last position; return when it listens."""
        folder = Path(self._folder.name)
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [PYTHON, ROOT / "tests" / "doubles" / "franka_server.py", folder / "positions", *self._options],
                stdout=log, stderr=log, env={**os.environ, **self._models})
        end = time.monotonic() + TIMEOUT
        while True:
            try:
                socket.create_connection(("127.0.0.1", HAND_PORT), 1.0).close()  # the arm's port serves one client
                return
            except OSError:
                if self._process.poll() is not None or time.monotonic() > end:
                    raise RuntimeError(f"franka-sim does not start: {self.text[-2000:]}") from None
                time.sleep(0.1)

    def crash(self) -> None:
        """Kill the controller."""
        self._process.kill()
        self._process.wait()

    def hit(self) -> None:
        """Stop the arm with a reflex."""
        self._process.send_signal(signal.SIGUSR1)

    @property
    def positions(self) -> list[float]:
        """Joint positions [rad]."""
        return list(np.fromfile(Path(self._folder.name) / "positions"))

    def freeze(self, seconds: float) -> None:
        """Suspend the controller for a while [s]."""
        self._process.send_signal(signal.SIGSTOP)
        try:
            time.sleep(seconds)
        finally:
            self._process.send_signal(signal.SIGCONT)

    @property
    def text(self) -> str:
        """The log so far."""
        return self.log.read_text(errors="replace")

    def __enter__(self) -> FrankaHost:
        return self

    def __exit__(self, *_: object) -> None:
        self.crash()
        self._folder.cleanup()
