"""Cells and commands of zencell for tests and benchmarks: as processes of their own, of which none is left behind, and,
where nothing of a process matters, in this one.
"""

from __future__ import annotations

import asyncio
import fcntl
import importlib
import io
import json
import logging
import os
import queue
import random
import signal
import socket
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections import deque
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
from common.transport.endpoint import BASE_PORT, endpoint_of
from common.transport.zenoh_session import connect

M = TypeVar("M", bound=Message)

ROOT = Path(__file__).resolve().parent.parent
DOMAINS = range(60, 233)
PATIENCE = 60.0  # [s] until a test gives up waiting for an event
logging.getLogger("watcher").addHandler(logging.NullHandler())  # that the router goes at the end is no news
_given: deque[int] = deque(maxlen=len(DOMAINS) // 4)  # lately, and perhaps not yet listened at
_locks: dict[int, int] = {}  # descriptors by the domains that this process has
SUMMARY, LOG = "summary.json", "cell.log"


def free_domain() -> int:
    """A domain whose port is free, and which no other process that asks here gets while this one lives.

    Tests that run beside each other have shares of their own; a suite and a benchmark, or two suites, have not.

    Raises:
        RuntimeError: none is.
    """
    share = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    domains = DOMAINS[share :: int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))]
    choices = [number for number in domains if number not in _given]
    random.shuffle(choices)
    for number in choices:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with suppress(OSError):
                probe.bind(("127.0.0.1", BASE_PORT + number))
                _take(number)
                _given.append(number)
                return number
    raise RuntimeError(f"no domain from {domains[0]} to {domains[-1]} is free")


def _take(domain: int) -> None:
    """Have the domain for as long as this process lives; an OSError if another one has it."""
    if domain in _locks:
        return
    folder = Path(tempfile.gettempdir(), f"zencell-test-domains-{os.getuid()}")
    folder.mkdir(exist_ok=True)
    lock = os.open(folder / str(domain), os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise
    _locks[domain] = lock


def folder_for(parent: Path, label: str) -> Path:
    """A new folder for the files of one run."""
    folder = parent / label.replace(" ", "_")
    folder.mkdir(parents=True)
    return folder


def command_line(*arguments: str) -> list[str]:
    """A command line of zencell with this interpreter."""
    return [sys.executable, "-P", "-m", "cli.main", *arguments]


def environment(folder: Path | None = None) -> dict[str, str]:
    """An environment in which zencell is found and told nothing; what persons decide is kept in the folder."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ZENCELL_")}
    return {**kept, "PYTHONPATH": str(ROOT)} | ({"XDG_STATE_HOME": str(folder / "state")} if folder else {})


def end_in_order() -> None:
    """Have SIGTERM end this process as Ctrl-C does, through its `with` blocks, so that no cell stays behind."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def _take_terminal() -> None:
    """Have Ctrl-C on the terminal that stdout is reach this process."""
    fcntl.ioctl(1, termios.TIOCSCTTY, 0)


class RunningCell:
    """A `zencell run` or `zencell up` in a domain of its own; its log and its summary are files in a folder."""

    def __init__(
        self, folder: Path, verb: str, cell: str, *arguments: str, secrets: Mapping[str, str] | None = None,
        output: int | None = None,
    ) -> None:
        """Start it; use it in a `with` block, at the end of which everything it started is gone.

        Args:
            folder: where the files go; must be there.
            verb: run or up.
            cell: name of the cell.
            arguments: further options, but for domain and summary; without `--viewer-port` there is no page.
            secrets: environment variables that no command line may show.
            output: descriptor of the file that stdout and stderr go to, instead of the log; a terminal is the one
                whose Ctrl-C it hears.
        """
        end_in_order()
        if "--viewer-port" not in arguments:
            arguments = (*arguments, "--no-viewer")
        self.folder, self.name = folder, cell
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
        """The processes that the cell's supervisor started, by service, whoever their parent is now."""
        return processes_of(self.domain)

    async def ended(self, timeout: float) -> int:
        """Exit code, once the command has ended by itself.

        Raises:
            TimeoutError: it has not within `timeout` seconds; the message ends with the last lines of the log.
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
        """Everything that it has written so far."""
        return (self.folder / LOG).read_text(errors="replace")

    def tail(self, lines: int = 30) -> str:
        """The last lines that it wrote."""
        return "\n".join(self.text.splitlines()[-lines:])

    @property
    def summary(self) -> dict[str, Any]:
        """The figures of the run, once it has ended."""
        value: dict[str, Any] = json.loads((self.folder / SUMMARY).read_text())
        return value

    def listen(self) -> AbstractAsyncContextManager[Bus]:
        """A bus in the cell for whoever watches, as soon as its router is there."""
        return connect(cell=self.name, service="watcher", endpoint=self.endpoint, timeout=PATIENCE)

    def tell(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """A zencell command that talks to this cell and ends by itself."""
        command = command_line(*arguments, "--domain", str(self.domain))
        return subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False)


class Zencell:
    """A running zencell command, its lines as they come, and its processes."""

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
        """The first line from now on that is wanted."""
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
        """The exit code, once the command has ended; all its lines are there then."""
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
        """All processes of this cell by name, whoever their parent is now."""
        return processes_of(self.domain)

    def until_childless(self, timeout: float = PATIENCE) -> None:
        """Return when no process is left."""
        deadline = time.monotonic() + timeout
        while left := self.children():
            assert time.monotonic() < deadline, f"left behind: {sorted(left)}"
            time.sleep(0.05)


def ask(
    folder: Path, *arguments: str, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """A zencell command that ends by itself, run in this process: its start is most of what it would take.

    Args:
        folder: where the person stands; modules that lie there are forgotten afterwards.
        arguments: of the command.
        environment: variables beside those of this process, of which zencell is told nothing.
    """
    out, err = io.StringIO(), io.StringIO()
    told = {name: value for name, value in os.environ.items() if not name.startswith("ZENCELL_")} | (environment or {})
    with (chdir(folder), patch.dict(os.environ, told, clear=True), own_modules(folder), redirect_stdout(out),
          redirect_stderr(err)):
        try:
            code = app.execute(arguments)
        except SystemExit as end:  # what a shell asks to complete words ends so
            code = int(end.code or 0)
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


@contextmanager
def own_modules(folder: Path) -> Iterator[None]:
    """Modules of a folder are found during the block and forgotten at its end, so that another may have the same."""
    with patch.object(sys, "path", [*sys.path]):
        importlib.invalidate_caches()
        try:
            yield
        finally:
            for name, module in list(sys.modules.items()):
                places = [getattr(module, "__file__", None) or "", *getattr(module, "__path__", ())]
                if any(Path(place).is_relative_to(folder) for place in places if place):
                    del sys.modules[name]


class Place:
    """A cell that is up in a folder, and how to ask about it."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        self.domain = domain
        self.started: list[Zencell] = []

    def start(self, *arguments: str) -> Zencell:
        """A command as a process of its own."""
        self.started.append(Zencell(self.folder, self.domain, *arguments))
        return self.started[-1]

    def end(self) -> None:
        """End whatever still runs of what was started."""
        for command in self.started:
            if command.process.poll() is None:
                command.interrupt()
                command.end()

    def ask(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """A command that ends by itself."""
        return ask(self.folder, *arguments, "--domain", str(self.domain))

    def say(self, *arguments: str) -> list[str]:
        """The lines of a command that goes well."""
        done = self.ask(*arguments)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout.splitlines()


@contextmanager
def place_of(folder: Path, file: str, *arguments: str) -> Iterator[Place]:
    """A cell that is up during the block and ends well."""
    place = Place(folder, free_domain())
    command = place.start("up", file, *arguments)
    try:
        command.until("zenoh --mode client")
        yield place
    finally:
        command.interrupt()
        assert command.end() == 0


def processes_of(domain: int) -> dict[str, psutil.Process]:
    """The processes that a supervisor started in a domain, by service, whoever their parent is now."""
    found = {}
    for process in psutil.process_iter(["cmdline", "status"]):
        command: list[str] = process.info["cmdline"] or []
        if "--gate" in command and "-m" in command and process.info["status"] != psutil.STATUS_ZOMBIE:
            at = command.index("--domain") + 1 if "--domain" in command else 0
            if command[at] == str(domain):
                # Helpers of a service look as it does, and began later.
                found.setdefault(command[command.index("-m") + 1].rpartition(".")[2], process)
    return found


def freeze(child: subprocess.Popen[Any]) -> None:
    """Stop a child; returns when all of its threads stand, up to 5 ms later: until then it may still answer."""
    child.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, child.pid, os.WSTOPPED | os.WNOWAIT)


async def until(reader: Reader[M], wanted: Callable[[M], bool], timeout: float = 60.0) -> M:
    """The first message from now on, or the newest there is, that is wanted.

    Raises:
        TimeoutError: none came within `timeout` seconds.
    """
    newest = reader.latest
    if newest is not None and wanted(newest):
        return newest
    async with asyncio.timeout(timeout):
        while not wanted(message := await reader.next()):
            pass
        return message


@asynccontextmanager
async def beside(*work: Any) -> AsyncIterator[None]:
    """Coroutines that run during the block and are cancelled at its end; what one raises is raised."""
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
    """Return as soon as a client can connect to the router.

    Raises:
        TimeoutError: none could within `timeout` seconds.
    """
    from common.transport.zenoh_session import close_within, open_zenoh

    async with asyncio.timeout(timeout):
        session = await open_zenoh(endpoint)
    await close_within(session, 0.5)
