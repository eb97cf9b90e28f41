"""Cells as processes of their own, for benchmarks and tests: started, listened to, and none left behind."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import random
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import psutil

from common.messages import Message
from common.transport.bus import Bus, Reader
from common.transport.connect import connect
from common.transport.endpoint import BASE_PORT, endpoint_of

M = TypeVar("M", bound=Message)

ROOT = Path(__file__).resolve().parent.parent
DOMAINS = range(60, 233)
logging.getLogger("watcher").addHandler(logging.NullHandler())  # that the router goes at the end is no news
_given: deque[int] = deque(maxlen=len(DOMAINS) // 4)  # lately, and perhaps not yet listened at
SUMMARY, LOG = "summary.json", "cell.log"


def free_domain() -> int:
    """A domain whose port is free. Tests that run beside each other have shares of their own, so that none meet.

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
                _given.append(number)
                return number
    raise RuntimeError(f"no domain from {domains[0]} to {domains[-1]} is free")


def folder_for(parent: Path, label: str) -> Path:
    """A new folder for the files of one run."""
    folder = parent / label.replace(" ", "_")
    folder.mkdir(parents=True)
    return folder


def command_line(*arguments: str) -> list[str]:
    """A command line of zencell with this interpreter."""
    return [sys.executable, "-P", "-m", "cli.main", *arguments]


def environment() -> dict[str, str]:
    """An environment in which zencell is found and told nothing."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ZENCELL_")}
    return {**kept, "PYTHONPATH": str(ROOT)}


def end_in_order() -> None:
    """Have SIGTERM end this process as Ctrl-C does, through its `with` blocks, so that no cell stays behind."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, signal.default_int_handler)


class RunningCell:
    """A `zencell run` or `zencell up` in a domain of its own; its log and its summary are files in a folder."""

    def __init__(
        self, folder: Path, verb: str, cell: str, *arguments: str, secrets: Mapping[str, str] | None = None
    ) -> None:
        """Start it; use it in a `with` block, at the end of which everything it started is gone.

        Args:
            folder: where the files go; must be there.
            verb: run or up.
            cell: name of the cell.
            arguments: further options, but for domain and summary; without `--viewer-port` there is no page.
            secrets: environment variables that no command line may show.
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
                command, cwd=folder, env={**environment(), **(secrets or {})}, stdin=subprocess.DEVNULL, stdout=log,
                stderr=subprocess.STDOUT, start_new_session=True,
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
        return {name: process for name, process in _services() if _domain_of(process) == self.domain}

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
        return connect(cell=self.name, service="watcher", endpoint=self.endpoint, timeout=30.0)

    def tell(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """A zencell command that talks to this cell and ends by itself."""
        command = command_line(*arguments, "--domain", str(self.domain))
        return subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=30, check=False)


def _services() -> Iterator[tuple[str, psutil.Process]]:
    for process in psutil.process_iter(["cmdline", "status"]):
        command = process.info["cmdline"] or []
        if "--gate" in command and "-m" in command and process.info["status"] != psutil.STATUS_ZOMBIE:
            yield command[command.index("-m") + 1].rpartition(".")[2], process


def _domain_of(process: psutil.Process) -> int:
    command: list[str] = process.info["cmdline"]
    return int(command[command.index("--domain") + 1]) if "--domain" in command else -1


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
