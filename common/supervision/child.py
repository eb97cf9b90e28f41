"""One child process: its gate, its lifeline, the lines that it writes, and its end."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import psutil

from common.process.loop_watch import STUCK_EXIT

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
        self._process: subprocess.Popen[bytes] | None = None
        self._exited: asyncio.Future[int] | None = None
        self._output = 0  # file descriptor
        self._rest = b""  # of a line that has not ended yet
        self._silent = asyncio.Event()  # nothing more can be written
        self._released = False

    @property
    def pid(self) -> int | None:
        """Process id while the process runs."""
        running = self._process is not None and self._exited is not None and not self._exited.done()
        return self._process.pid if running and self._process else None

    @property
    def stopped(self) -> bool:
        """Whether the process is there but was stopped (SIGSTOP)."""
        with contextlib.suppress(psutil.Error):
            return self.pid is not None and psutil.Process(self.pid).status() == psutil.STATUS_STOPPED
        return False

    @property
    def waited(self) -> float:
        """For how long [s] its first thread, which turns its loop, has been kept waiting for a processor so far.

        0 where the system does not tell.
        """
        with contextlib.suppress(OSError, ValueError, IndexError):
            return int(Path(f"/proc/{self.pid}/schedstat").read_text().split()[1]) * 1e-9
        return 0.0

    @property
    def alive_seconds(self) -> float:
        """Time [s] since the process was started."""
        return time.monotonic() - self.started_at

    def start(self) -> None:
        """Start the process, behind its gate; on the running loop."""
        # Not asyncio's own subprocesses: before Python 3.12 they wait until nobody holds the output open any more,
        # and a process that ours left behind may do so for ever.
        self.tail.clear()
        self._released = False
        self._rest = b""
        self._silent.clear()
        self.started_at = time.monotonic()
        process = self._process = subprocess.Popen(
            self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, bufsize=0,
            env=self.environment, start_new_session=True,
        )
        assert process.stdout is not None
        self._output = process.stdout.fileno()
        os.set_blocking(self._output, False)
        loop = asyncio.get_running_loop()
        loop.add_reader(self._output, self._read)
        self._exited = loop.create_future()
        threading.Thread(
            target=_await_exit, args=(process, loop, self._exited), name=f"wait for {self.name}", daemon=True
        ).start()

    def release(self) -> None:
        """Let the process through its gate; without effect the second time."""
        if self._released or self._process is None or self._process.stdin is None:
            return
        self._released = True
        with contextlib.suppress(OSError, ValueError):  # it died meanwhile: wait() tells
            self._process.stdin.write(b"go\n")

    async def wait(self) -> int:
        """Exit code of the process (minus the signal that killed it), once its last lines were read."""
        assert self._process is not None and self._exited is not None, "not started"
        code = await asyncio.shield(self._exited)
        with contextlib.suppress(TimeoutError):  # a stray that moved to another session may hold the pipe open
            async with asyncio.timeout(1.0):
                await self._silent.wait()
        self._close()
        return code

    def terminate(self) -> None:
        """Ask the process to end (SIGTERM)."""
        if self.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """End the process and everything that it started, at once (SIGKILL)."""
        if self.pid is not None:
            _kill_group(self.pid)

    def _close(self) -> None:
        assert self._process is not None
        if not self._silent.is_set():
            self._fall_silent()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()

    def _read(self) -> None:
        try:
            chunk = os.read(self._output, 65536)
        except BlockingIOError:
            return
        except OSError:
            chunk = b""
        if not chunk:
            self._fall_silent()
            return
        *lines, rest = (self._rest + chunk).split(b"\n")
        self._rest = rest[: 4 * LONGEST_LINE]
        for line in lines:
            self._emit(line)

    def _fall_silent(self) -> None:
        asyncio.get_running_loop().remove_reader(self._output)
        self._emit(self._rest)
        self._rest = b""
        self._silent.set()

    def _emit(self, raw: bytes) -> None:
        line = raw.decode("utf-8", "replace").rstrip()[:LONGEST_LINE]
        if line:
            self.tail.append(line)
            self._on_line(self.name, line)


def _await_exit(process: subprocess.Popen[bytes], loop: asyncio.AbstractEventLoop, exited: asyncio.Future[int]) -> None:
    """Wait for the end of a process, on a thread, and take whatever it left behind with it."""
    if hasattr(os, "waitid"):  # not everywhere; until it is reaped, nobody else can have its number
        with contextlib.suppress(ChildProcessError):
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    else:
        process.wait()
    _kill_group(process.pid)
    code = process.wait()

    def tell() -> None:
        if not exited.done():
            exited.set_result(code)

    with contextlib.suppress(RuntimeError):  # the loop has ended
        loop.call_soon_threadsafe(tell)


def _kill_group(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


def describe_exit(code: int) -> str:
    """What an exit code means, for people: "exit code 1", "killed by SIGKILL"."""
    if code == STUCK_EXIT:
        return f"its event loop was stuck, exit code {code}"
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"


class Backoff:
    """A delay that doubles with each failure up to a cap, and starts over after a long enough life."""

    def __init__(self, first: float = 0.1, factor: float = 2.0, most: float = 5.0, reset_after: float = 10.0) -> None:
        """Start at the shortest delay.

        Args:
            first: delay after the first failure [s].
            factor: growth from one failure to the next.
            most: the delay never exceeds this [s].
            reset_after: a life at least this long counts as healthy [s].
        """
        self.first = first
        self.factor = factor
        self.most = most
        self.reset_after = reset_after
        self._next = first

    def after(self, alive_seconds: float) -> float:
        """Delay [s] before the next start, for a process that lived this long."""
        if alive_seconds >= self.reset_after:
            self._next = self.first
        delay = self._next
        self._next = min(self.most, delay * self.factor)
        return delay
