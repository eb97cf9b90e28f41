"""Subscriber processes that do not keep up: slow ones, and frozen ones.

`python -m tests.cells.subscribers ENDPOINT KEY SECONDS` is a subscriber that sleeps in each callback until its standard
input is closed.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import zenoh

from common.transport.endpoint import client_config
from tests.harness import ROOT, environment

CONNECT_MS = 30_000


class Subscriber:
    """A subscriber process that ends with its `with` block."""

    def __init__(self, endpoint: str, key: str, rest: float) -> None:
        """Start the process and wait until it has subscribed.

        Args:
            endpoint: of the router.
            key: key expression, such as `panda/**`.
            rest: time that it sleeps in the callback of each message [s].

        Raises:
            RuntimeError: the process ended instead.
        """
        command = [sys.executable, "-m", "tests.cells.subscribers", endpoint, key, str(rest)]
        self.process = subprocess.Popen(command, cwd=ROOT, env=environment(), stdin=subprocess.PIPE,
                                        stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        if not self.process.stdout.readline():
            raise RuntimeError(f"a subscriber ended with {self.process.wait()}")

    def freeze(self) -> None:
        """Stop the process: its connection stays open and nothing is read from it."""
        self.process.send_signal(signal.SIGSTOP)

    def wake(self) -> None:
        """Continue the process; it reconnects if the router dropped it meanwhile."""
        self.process.send_signal(signal.SIGCONT)

    def __enter__(self) -> Subscriber:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.communicate()


def main() -> int:
    """Subscribe, print it, and sleep in each callback until the parent process closes the standard input or dies."""
    endpoint, key, rest = sys.argv[1:]
    session = zenoh.open(client_config(endpoint, connect_ms=CONNECT_MS))
    seconds = float(rest)
    # Direct: unread messages wait in the connection and not in a queue of this process.
    slowly = zenoh.handlers.Callback(lambda _sample: time.sleep(seconds), indirect=False)
    subscriber = session.declare_subscriber(key, slowly)
    print("subscribed to", subscriber.key_expr, flush=True)  # noqa: T201
    sys.stdin.read()
    os._exit(0)  # closing would wait for the sleeping callback


if __name__ == "__main__":
    raise SystemExit(main())
