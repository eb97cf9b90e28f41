"""Subscribers that do not keep up, as processes of their own: one reads slowly, one has stopped reading at all.

`python -m tests.cells.subscribers ENDPOINT KEY SECONDS` is a subscriber that sleeps in each callback.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from typing import IO

import zenoh

from common.transport.endpoint import client_config
from tests.harness import ROOT, environment

CONNECT_MS = 30_000


class Subscriber:
    """A process that subscribes to everything of a cell; gone at the end of its `with` block."""

    def __init__(self, endpoint: str, key: str, rest: float) -> None:
        """Start it; it has subscribed when this returns.

        Args:
            endpoint: of the router.
            key: key expression, such as `panda/**`.
            rest: how long it does nothing over each message [s].

        Raises:
            RuntimeError: it ended instead.
        """
        command = [sys.executable, "-m", "tests.cells.subscribers", endpoint, key, str(rest)]
        self.process = subprocess.Popen(command, cwd=ROOT, env=environment(), stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self._output: IO[str] = self.process.stdout
        if not self._output.readline():
            raise RuntimeError(f"a subscriber ended with {self.process.wait()}")

    def freeze(self) -> None:
        """Stop it in the middle of whatever it does: its connection stays open and nothing is read from it."""
        self.process.send_signal(signal.SIGSTOP)

    def wake(self) -> None:
        """Let it go on; if it was dropped by the router meanwhile, it comes back."""
        self.process.send_signal(signal.SIGCONT)

    def __enter__(self) -> Subscriber:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        self._output.close()


def main() -> int:
    """Subscribe, say so, and rest over each message until killed."""
    endpoint, key, rest = sys.argv[1:]
    parent = os.getppid()
    session = zenoh.open(client_config(endpoint, connect_ms=CONNECT_MS))
    seconds = float(rest)
    # Direct: what is not read waits in the connection and not in a queue of this process.
    subscriber = session.declare_subscriber(
        key, zenoh.handlers.Callback(lambda _sample: time.sleep(seconds), indirect=False)
    )
    print("subscribed to", subscriber.key_expr, flush=True)  # noqa: T201
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(0)  # closing would wait for the sleeping callback


if __name__ == "__main__":
    raise SystemExit(main())
