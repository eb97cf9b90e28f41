"""franka-sim as a test host: the maker's protocol with an arm of MuJoCo behind it, in an environment of its own.

`make franka-sim` makes that environment.
"""

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
PORTS = (1337, 1338)  # of arm and hand; they are part of the protocol: one such host at a time
READY = 60.0  # [s]


class FrankaHost:
    """A controller that answers at 127.0.0.1; options are those of franka-sim's server."""

    def __init__(self, *options: str) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._options = options
        folder = Path(self._folder.name)
        subprocess.run([PYTHON, ROOT / "tests" / "doubles" / "franka_model.py", folder], check=True)
        self._models = {"FR3_MJCF": str(folder / "fr3.xml"), "FRANKA_HAND_MJCF": str(folder / "hand.xml")}
        self.log = folder / "log"
        self._process: subprocess.Popen[bytes]
        self.boot()

    def boot(self) -> None:
        """Start the controller, with the arm where it stood; returns when it listens."""
        folder = Path(self._folder.name)
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [PYTHON, ROOT / "tests" / "doubles" / "franka_server.py", folder / "stands", *self._options],
                stdout=log, stderr=log, env={**os.environ, **self._models})
        end = time.monotonic() + READY
        while True:
            try:
                # Not the arm's own port: that is for one client at a time.
                socket.create_connection(("127.0.0.1", PORTS[1]), 1.0).close()
                return
            except OSError:
                if self._process.poll() is not None or time.monotonic() > end:
                    raise RuntimeError(f"franka-sim does not start: {self.text[-2000:]}") from None
                time.sleep(0.1)

    def crash(self) -> None:
        """Have the controller be gone at once."""
        self._process.kill()
        self._process.wait()

    def hit(self) -> None:
        """Have the arm stop with a reflex."""
        self._process.send_signal(signal.SIGUSR1)

    @property
    def stands(self) -> list[float]:
        """Where its joints are [rad]."""
        return list(np.fromfile(Path(self._folder.name) / "stands"))

    def freeze(self, seconds: float) -> None:
        """Have it do and say nothing for a while [s]."""
        self._process.send_signal(signal.SIGSTOP)
        try:
            time.sleep(seconds)
        finally:
            self._process.send_signal(signal.SIGCONT)

    @property
    def text(self) -> str:
        """What it said."""
        return self.log.read_text(errors="replace")

    def __enter__(self) -> FrankaHost:
        return self

    def __exit__(self, *_: object) -> None:
        self.crash()
        self._folder.cleanup()
