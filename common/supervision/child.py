"""One child process: its gate, its output lines, its exit, and the delay before it is restarted."""

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

from common.process.lifeline import STUCK_EXIT
from common.supervision.preloaded import Forked, Preloaded, reap_group

TAIL_LINES = 50
LONGEST_LINE = 4000  # [characters] the rest of a longer line is cut


class Child:
    """A process in a session of its own, so that Ctrl-C at the terminal reaches only its parent.

    Its stdin is both gate and lifeline: the process waits for a first line before it starts its work, and exits when
    stdin is closed, which the kernel does however this process ends.
    """

    def __init__(
        self, name: str, command: Sequence[str], environment: Mapping[str, str], on_line: Callable[[str, str], None],
        preloaded: Preloaded | None = None,
    ) -> None:
        """Describe a process without starting it.

        Args:
            name: of the process in logs.
            command: program and arguments.
            environment: its complete environment.
            on_line: called with the name and each line that the process writes to stdout or stderr.
            preloaded: forks the process, where it can; it starts faster and shares memory then.
        """
        self.name = name
        self._preloaded = preloaded
        self.command = list(command)
        self.environment = dict(environment)
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.started_at = 0.0  # [s, monotonic]
        self._on_line = on_line
        self._process: subprocess.Popen[bytes] | Forked | None = None
        self._exited: asyncio.Future[int] | None = None
        self._output = 0  # file descriptor
        self._rest = b""  # of an incomplete line
        self._output_ended = asyncio.Event()
        self._released = False

    @property
    def pid(self) -> int | None:
        """Process id while the process runs."""
        running = self._process is not None and self._exited is not None and not self._exited.done()
        return self._process.pid if running and self._process else None

    @property
    def stopped(self) -> bool:
        """Whether the process exists but is stopped (SIGSTOP)."""
        with contextlib.suppress(psutil.Error):
            return self.pid is not None and psutil.Process(self.pid).status() == psutil.STATUS_STOPPED
        return False

    @property
    def waited(self) -> float:
        """Total time [s] that its main thread, which runs its loop, waited for a processor; 0 if unknown."""
        with contextlib.suppress(OSError, ValueError, IndexError):
            return int(Path(f"/proc/{self.pid}/schedstat").read_text().split()[1]) * 1e-9
        return 0.0

    @property
    def alive_seconds(self) -> float:
        """Time [s] since the process was started."""
        return time.monotonic() - self.started_at

    def start(self) -> None:
        """Start the process, behind its gate, on the running loop."""
        # asyncio's subprocesses wait until every copy of the output pipe is closed (before Python 3.12). A process
        # that the child left behind may hold one forever.
        self.tail.clear()
        self._released = False
        self._rest = b""
        self._output_ended.clear()
        self.started_at = time.monotonic()
        process = self._process = (self._preloaded and self._preloaded.spawn(self.command, self.environment)
                                   ) or subprocess.Popen(
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
        """Open the gate; a second call has no effect."""
        if self._released or self._process is None or self._process.stdin is None:
            return
        self._released = True
        with contextlib.suppress(OSError, ValueError):  # it died meanwhile: wait() returns its exit code
            self._process.stdin.write(b"go\n")

    async def wait(self) -> int:
        """Return the exit code (minus the signal that killed the process), once its last lines are read."""
        assert self._process is not None and self._exited is not None, "not started"
        code = await asyncio.shield(self._exited)
        with contextlib.suppress(TimeoutError):  # a grandchild in another session may hold the pipe open
            async with asyncio.timeout(1.0):
                await self._output_ended.wait()
        self._close()
        return code

    def terminate(self) -> None:
        """Ask the process to end (SIGTERM)."""
        if self.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """Kill the process and everything that it started (SIGKILL)."""
        if self.pid is not None:
            _kill_group(self.pid)

    def _close(self) -> None:
        assert self._process is not None
        if not self._output_ended.is_set():
            self._end_output()
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
            self._end_output()
            return
        *lines, rest = (self._rest + chunk).split(b"\n")
        self._rest = rest[: 4 * LONGEST_LINE]
        for line in lines:
            self._emit(line)

    def _end_output(self) -> None:
        asyncio.get_running_loop().remove_reader(self._output)
        self._emit(self._rest)
        self._rest = b""
        self._output_ended.set()

    def _emit(self, raw: bytes) -> None:
        line = raw.decode("utf-8", "replace").rstrip()[:LONGEST_LINE]
        if line:
            self.tail.append(line)
            self._on_line(self.name, line)


def _await_exit(
    process: subprocess.Popen[bytes] | Forked, loop: asyncio.AbstractEventLoop, exited: asyncio.Future[int]
) -> None:
    """Wait on a thread for the end of a process, and kill the processes that it left behind."""
    if hasattr(os, "waitid"):  # not on every system; its process id is not reused until it is reaped
        with contextlib.suppress(ChildProcessError):
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    else:
        process.wait()
    _kill_group(process.pid)
    code = process.wait()
    reap_group(process.pid)

    def set_code() -> None:
        if not exited.done():
            exited.set_result(code)

    with contextlib.suppress(RuntimeError):  # the loop has ended
        loop.call_soon_threadsafe(set_code)


def _kill_group(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


def describe_exit(code: int) -> str:
    """Return an exit code in words, such as "exit code 1" or "killed by SIGKILL"."""
    if code == STUCK_EXIT:
        return f"its event loop was stuck, exit code {code}"
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"


class Backoff:
    """A delay that doubles with each failure up to a cap, and starts over after a long enough run."""

    def __init__(self, first: float = 0.1, factor: float = 2.0, most: float = 5.0, reset_after: float = 10.0) -> None:
        """Start at the shortest delay.

        Args:
            first: delay after the first failure [s].
            factor: growth from one failure to the next.
            most: longest delay [s].
            reset_after: a run of at least this time counts as healthy [s].
        """
        self.first = first
        self.factor = factor
        self.most = most
        self.reset_after = reset_after
        self._next = first

    def after(self, alive_seconds: float) -> float:
        """Return the delay [s] before the next start of a process that ran for `alive_seconds`."""
        if alive_seconds >= self.reset_after:
            self._next = self.first
        delay = self._next
        self._next = min(self.most, delay * self.factor)
        return delay
