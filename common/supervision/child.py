"""One child process: its gate, its lifeline, the lines that it writes, and its end."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence

TAIL_LINES = 50
LONGEST_LINE = 4000  # [characters] the rest of a longer line is cut


class Child:
    """A process in a session of its own, so that a terminal's Ctrl-C reaches only its parent.

    Its stdin is gate and lifeline in one: the process waits for a first line before it begins its work, and ends when
    stdin is closed, which the kernel does for us however this process ends.
    """

    def __init__(
        self, name: str, command: Sequence[str], environment: Mapping[str, str], on_line: Callable[[str, str], None]
    ) -> None:
        """Describe a process without starting it.

        Args:
            name: what the process is called in logs.
            command: program and arguments.
            environment: all of its environment.
            on_line: called with the name and each line that the process writes to stdout or stderr.
        """
        self.name = name
        self.command = list(command)
        self.environment = dict(environment)
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.started_at = 0.0  # [s, monotonic]
        self._on_line = on_line
        self._process: asyncio.subprocess.Process | None = None
        self._reading: asyncio.Task[None] | None = None
        self._released = False

    @property
    def pid(self) -> int | None:
        """Process id while the process runs."""
        return self._process.pid if self._process is not None and self._process.returncode is None else None

    @property
    def alive_seconds(self) -> float:
        """Time [s] since the process was started."""
        return time.monotonic() - self.started_at

    async def start(self) -> None:
        """Start the process, behind its gate."""
        self.tail.clear()
        self._released = False
        self.started_at = time.monotonic()
        self._process = await asyncio.create_subprocess_exec(
            *self.command,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=self.environment,
            start_new_session=True,
        )
        self._reading = asyncio.create_task(self._read_lines(self._process))

    def release(self) -> None:
        """Let the process through its gate; without effect the second time."""
        if self._released or self._process is None or self._process.stdin is None:
            return
        self._released = True
        with contextlib.suppress(OSError, RuntimeError):  # it died meanwhile: wait() tells
            self._process.stdin.write(b"go\n")

    async def wait(self) -> int:
        """Exit code of the process (minus the signal that killed it), once its last lines were read."""
        assert self._process is not None and self._reading is not None, "not started"
        code = await self._process.wait()
        self._kill_group()  # whatever it started and left behind
        with contextlib.suppress(TimeoutError):  # a stray that moved to another session may hold the pipe open
            await asyncio.wait_for(asyncio.shield(self._reading), 1.0)
        self._reading.cancel()
        if self._process.stdin is not None:
            self._process.stdin.close()
        return code

    def terminate(self) -> None:
        """Ask the process to end (SIGTERM)."""
        if self.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """End the process and everything that it started, at once (SIGKILL)."""
        if self.pid is not None:
            self._kill_group()

    def _kill_group(self) -> None:
        assert self._process is not None
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)

    async def _read_lines(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None
        rest = b""
        while chunk := await process.stdout.read(65536):
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                self._emit(line)
            rest = rest[: 4 * LONGEST_LINE]
        if rest:
            self._emit(rest)

    def _emit(self, raw: bytes) -> None:
        line = raw.decode("utf-8", "replace").rstrip()[:LONGEST_LINE]
        if line:
            self.tail.append(line)
            self._on_line(self.name, line)


def describe_exit(code: int) -> str:
    """What an exit code means, for people: "exit code 1", "killed by SIGKILL"."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
