"""Start cells and commands of zencell for tests and benchmarks, as processes or within this one; leave none behind."""

from __future__ import annotations

import asyncio
import fcntl
import importlib
import io
import json
import logging
import os
import queue
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import (
    AbstractAsyncContextManager,
    asynccontextmanager,
    chdir,
    contextmanager,
    redirect_stderr,
    redirect_stdout,
    suppress,
)
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import patch

import psutil

from cli.main import app
from common.messages import Message
from common.transport.bus import Bus, Reader
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect
from tests.domains import free_domain

M = TypeVar("M", bound=Message)

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 60.0  # [s] timeout of a test that waits for an event
logging.getLogger("watcher").addHandler(logging.NullHandler())  # the end of the router needs no message
SUMMARY, LOG = "summary.json", "cell.log"


def folder_for(parent: Path, label: str) -> Path:
    """Create a folder for the files of one run."""
    folder = parent / label.replace(" ", "_")
    folder.mkdir(parents=True)
    return folder


def command_line(*arguments: str) -> list[str]:
    """Return a command line of zencell with this interpreter."""
    return [sys.executable, "-P", "-m", "cli.main", *arguments]


def environment(folder: Path | None = None) -> dict[str, str]:
    """Return an environment that finds zencell, without ZENCELL_ variables, with persistent state in the folder."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("ZENCELL_")}
    return {**inherited, "PYTHONPATH": str(ROOT)} | ({"XDG_STATE_HOME": str(folder / "state")} if folder else {})


def end_in_order() -> None:
    """Let SIGTERM end this process like Ctrl-C, through its `with` blocks, so that no cell is left behind."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def _take_terminal() -> None:
    """Make the terminal on stdout the controlling one, so that its Ctrl-C reaches this process."""
    fcntl.ioctl(1, termios.TIOCSCTTY, 0)


class RunningCell:
    """A `zencell run` or `zencell up` process in its own domain, with log and summary files in a folder."""

    def __init__(
        self, folder: Path, verb: str, cell: str, *arguments: str, secrets: Mapping[str, str] | None = None,
        output: int | None = None,
    ) -> None:
        """Start the cell; the end of the `with` block ends all of its processes.

        Args:
            folder: existing folder for the files.
            verb: run or up.
            cell: name of the cell, or of its file in the folder.
            arguments: further options except domain and summary; no page without `--viewer-port`.
            secrets: environment variables that must not appear on a command line.
            output: file descriptor for stdout and stderr instead of the log; a terminal becomes the controlling one.
        """
        end_in_order()
        if "--viewer-port" not in arguments:
            arguments = (*arguments, "--no-viewer")
        self.folder, self.name = folder, Path(cell).stem
        self.domain = free_domain()
        self.endpoint = endpoint_of(self.domain)
        command = command_line(verb, cell, *arguments, "--domain", str(self.domain), "--summary", str(folder / SUMMARY))
        with (folder / LOG).open("wb") as log:
            self.process = subprocess.Popen(
                command, cwd=folder, env={**environment(folder), **(secrets or {})}, stdin=subprocess.DEVNULL,
                stdout=log if output is None else output, stderr=subprocess.STDOUT, start_new_session=True,
                preexec_fn=_take_terminal if output is not None and os.isatty(output) else None,  # noqa: PLW1509
            )

    def __enter__(self) -> RunningCell:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        for process in self.processes().values():
            with suppress(psutil.NoSuchProcess):
                process.kill()

    def processes(self) -> dict[str, psutil.Process]:
        """Return the processes of the cell by service, whatever their parent is now."""
        return processes_of(self.domain)

    async def ended(self, timeout: float) -> int:
        """Wait for the end of the command and return its exit code.

        Raises:
            TimeoutError: after `timeout` seconds, with the last log lines.
        """
        try:
            return await asyncio.to_thread(self.process.wait, timeout)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"did not end within {timeout:g} s; its last lines:\n{self.tail()}") from None

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        self.process.send_signal(signal.SIGINT)

    @property
    def text(self) -> str:
        """The log so far."""
        return (self.folder / LOG).read_text(errors="replace")

    def tail(self, lines: int = 30) -> str:
        """Return the last log lines."""
        return "\n".join(self.text.splitlines()[-lines:])

    @property
    def summary(self) -> dict[str, Any]:
        """The summary file of an ended run."""
        value: dict[str, Any] = json.loads((self.folder / SUMMARY).read_text())
        return value

    def listen(self) -> AbstractAsyncContextManager[Bus]:
        """Connect a bus to the cell as soon as its router is up."""
        return connect(cell=self.name, service="watcher", endpoint=self.endpoint, timeout=PATIENCE)

    def command(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a zencell command against this cell to its end."""
        command = command_line(*arguments, "--domain", str(self.domain))
        return subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False)


class Zencell:
    """A running zencell command with its output lines and processes."""

    def __init__(self, folder: Path, domain: int, *arguments: str) -> None:
        self.domain = domain
        self.lines: list[str] = []
        self._new: queue.Queue[str] = queue.Queue()
        self.process = subprocess.Popen(
            command_line(*arguments, "--domain", str(domain)), cwd=folder, env=environment(folder),
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        )
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._new.put(line.rstrip("\n"))
        self._new.put("")

    def until(self, wanted: Callable[[str], bool] | str, *, timeout: float = PATIENCE) -> str:
        """Return the first new line that contains a text or satisfies a condition."""
        deadline = time.monotonic() + timeout
        while True:
            try:
                line = self._new.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"{wanted!r} did not come; so far:\n" + "\n".join(self.lines)) from None
            self.lines.append(line)
            if wanted in line if isinstance(wanted, str) else wanted(line):
                return line
            if not line and not self._reading.is_alive() and self._new.empty():
                raise AssertionError(f"{wanted!r} never came:\n" + "\n".join(self.lines))

    def end(self, timeout: float = PATIENCE) -> int:
        """Wait for the end of the command, collect all lines, and return the exit code."""
        code = self.process.wait(timeout)
        self._reading.join(timeout)
        while not self._new.empty():
            self.lines.append(self._new.get())
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        self.process.send_signal(signal.SIGINT)

    def children(self) -> dict[str, psutil.Process]:
        """Return the processes of this cell by service, whatever their parent is now."""
        return processes_of(self.domain)

    def until_childless(self, timeout: float = PATIENCE) -> None:
        """Wait until no process is left."""
        deadline = time.monotonic() + timeout
        while left := self.children():
            assert time.monotonic() < deadline, f"left behind: {sorted(left)}"
            time.sleep(0.05)


def ask(
    folder: Path, *arguments: str, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a zencell command to its end within this process, which saves the start of an interpreter.

    Args:
        folder: working directory; modules in it are unloaded afterwards.
        arguments: of the command.
        environment: variables in addition to those of this process without the ZENCELL_ ones.
    """
    out, err = io.StringIO(), io.StringIO()
    variables = {name: value for name, value in os.environ.items() if not name.startswith("ZENCELL_")}
    variables |= environment or {}
    with (chdir(folder), patch.dict(os.environ, variables, clear=True), own_modules(folder), redirect_stdout(out),
          redirect_stderr(err)):
        try:
            code = app.execute(arguments)
        except SystemExit as end:  # the completion protocol of shells exits
            code = int(end.code or 0)
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


@contextmanager
def own_modules(folder: Path) -> Iterator[None]:
    """Make modules of a folder importable during the block, and unload them at its end."""
    with patch.object(sys, "path", [*sys.path]):
        importlib.invalidate_caches()
        try:
            yield
        finally:
            for name, module in list(sys.modules.items()):
                places = [getattr(module, "__file__", None) or "", *getattr(module, "__path__", ())]
                if any(f"{place}/".startswith(f"{folder}/") for place in places):
                    del sys.modules[name]


class Place:
    """A running cell of a folder, for commands against it."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        self.domain = domain
        self.started: list[Zencell] = []

    def start(self, *arguments: str) -> Zencell:
        """Start a command as a process."""
        self.started.append(Zencell(self.folder, self.domain, *arguments))
        return self.started[-1]

    def end(self) -> None:
        """End all started commands."""
        for command in self.started:
            if command.process.poll() is None:
                command.interrupt()
                command.end()

    def ask(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command to its end within this process."""
        return ask(self.folder, *arguments, "--domain", str(self.domain))

    def say(self, *arguments: str) -> list[str]:
        """Run a command that must succeed, and return its lines."""
        done = self.ask(*arguments)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout.splitlines()


@contextmanager
def place_of(folder: Path, file: str, *arguments: str) -> Iterator[Place]:
    """Run a cell during the block; it must end with exit code 0."""
    place = Place(folder, free_domain())
    command = place.start("up", file, *arguments)
    try:
        command.until("zenoh --mode client")
        yield place
    finally:
        command.interrupt()
        assert command.end() == 0


def processes_of(domain: int) -> dict[str, psutil.Process]:
    """Return the processes of a domain by service, whatever their parent is now."""
    found = {}
    for process in psutil.process_iter(["cmdline", "status"]):
        command: list[str] = process.info["cmdline"] or []
        if "--gate" in command and "-m" in command and process.info["status"] != psutil.STATUS_ZOMBIE:
            at = command.index("--domain") + 1 if "--domain" in command else 0
            if command[at] == str(domain):
                # Worker processes have the same command line and are younger.
                found.setdefault(command[command.index("-m") + 1].rpartition(".")[2], process)
    return found


def freeze(child: subprocess.Popen[Any]) -> None:
    """Stop a child process and wait until all of its threads are stopped, up to 5 ms later."""
    child.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, child.pid, os.WSTOPPED | os.WNOWAIT)


async def until(reader: Reader[M], wanted: Callable[[M], bool], timeout: float = 60.0) -> M:
    """Return the latest message, or the first new one, that satisfies a condition.

    Raises:
        TimeoutError: after `timeout` seconds.
    """
    newest = reader.latest
    if newest is not None and wanted(newest):
        return newest
    async with asyncio.timeout(timeout):
        while not wanted(message := await reader.next()):
            pass
        return message


@asynccontextmanager
async def running_with(*work: Any) -> AsyncIterator[None]:
    """Run coroutines during the block, cancel them at its end, and raise their exceptions."""
    tasks = [asyncio.create_task(one) for one in work]
    try:
        yield
        for task in tasks:
            if task.done():
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def wait_router(endpoint: str, timeout: float) -> None:
    """Wait until a client can connect to the router.

    Raises:
        TimeoutError: after `timeout` seconds.
    """
    from common.transport.zenoh_session import close_within, open_zenoh

    async with asyncio.timeout(timeout):
        session = await open_zenoh(endpoint)
    await close_within(session, 0.5)
