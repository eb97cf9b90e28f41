"""A package of tiny services, a cell made of them, and the real command around it."""

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from benchmarks.runs import free_domain

ROOT = Path(__file__).resolve().parent.parent.parent
PATIENCE = 40.0  # [s] until a test gives up waiting for an event

SERVICE = '''"""A tiny service."""
import asyncio, os, sys
from common.applications.pick_place.topics import PICK_PLACE_STATUS
from common.applications.pick_place.messages import PickPlaceStatus
from common import topics
from common.config import Parameters
from common.errors import ConfigError

from common.process.service import main

class Config(Parameters):
    """What it does."""
    behave: str = "well"
    placed: int = 0

async def run(bus, config):
    print("hello from", bus.service, flush=True)
    if config.behave == "never ready":
        bus.log.info("waiting for the moon")
        await asyncio.Event().wait()
    if config.behave == "wrong":
        raise ConfigError("behave", config.behave, "can not be done")
    if config.behave == "crash once" and not os.path.exists(sys.argv[0] + ".crashed"):
        open(sys.argv[0] + ".crashed", "w").close()
        raise RuntimeError("a bug")
    status = bus.writer(PICK_PLACE_STATUS) if bus.service == "last" else None
    await bus.ready()
    if status is not None:
        state = {"done": "DONE", "error": "ERROR"}.get(config.behave, "IDLE")
        status.put(PickPlaceStatus(header=bus.header(), state=state, started=True, placed=config.placed, targets=2))
    await asyncio.Event().wait()

if __name__ == "__main__":
    main(run, Config)
'''

TALKER = '''"""Sends pictures and answers what the task is told."""
import asyncio
from common import topics
from common.config import Parameters
from common.errors import Refused
from common.messages import Image, TaskStatus
from common.process.service import main

class Config(Parameters):
    """Nothing."""

async def run(bus, config):
    async def answer(request):
        if request.command == "stop":
            raise Refused("busy", "not now")
        if request.command == "resume":
            await asyncio.Event().wait()
        return TaskStatus(header=bus.header(), paused=request.command == "pause")
    images = bus.writer(topics.CAMERA_IMAGE)
    bus.serve(topics.TASK_COMMAND, answer)
    await bus.ready()
    while True:
        images.put(Image(header=bus.header("camera"), height=3, width=4, encoding="bgr8", data=bytes(36)))
        await asyncio.sleep(0.05)

if __name__ == "__main__":
    main(run, Config)
'''

CELL = """# Three tiny services.
cell: tiny
robot: panda
world: balls
pipeline: cartesian_ompl
task: last
services:
  fakes.first: {}
  fakes.middle: {}
  fakes.last: {}
"""


def make_folder(path: Path) -> Path:
    """Where a person stands: a package of services and a cell file."""
    package = path / "fakes"
    package.mkdir()
    (package / "__init__.py").touch()
    for name in ("first", "middle", "last"):
        (package / f"{name}.py").write_text(SERVICE)
    (package / "talker.py").write_text(TALKER)
    (path / "tiny.yaml").write_text(CELL)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of its own for each test."""
    return make_folder(tmp_path)


@pytest.fixture
def domain() -> int:
    """A domain of its own for each test."""
    return free_domain()


def command_line(*arguments: str) -> list[str]:
    """A command line of zencell."""
    return [sys.executable, "-P", "-m", "cli.main", *arguments]


def environment() -> dict[str, str]:
    """An environment in which zencell is found and told nothing."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ZENCELL_")}
    return {**kept, "PYTHONPATH": str(ROOT)}


class Zencell:
    """A running zencell command, its lines as they come, and its processes."""

    def __init__(self, folder: Path, domain: int, *arguments: str) -> None:
        self.domain = domain
        self.lines: list[str] = []
        self._new: queue.Queue[str] = queue.Queue()
        self.process = subprocess.Popen(
            command_line(*arguments, "--domain", str(domain)), cwd=folder, env=environment(),
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
        found = {}
        for process in psutil.process_iter(["cmdline", "status"]):
            command = process.info["cmdline"] or []
            if "--gate" in command and str(self.domain) in command and process.info["status"] != psutil.STATUS_ZOMBIE:
                found[command[command.index("-m") + 1].rpartition(".")[2]] = process
        return found

    def until_childless(self, timeout: float = PATIENCE) -> None:
        """Return when no process is left."""
        deadline = time.monotonic() + timeout
        while left := self.children():
            assert time.monotonic() < deadline, f"left behind: {sorted(left)}"
            time.sleep(0.05)


@pytest.fixture
def zencell(folder: Path, domain: int) -> Iterator[Callable[..., Zencell]]:
    """Starts zencell commands, and leaves nothing behind itself."""
    started: list[Zencell] = []

    def start(*arguments: str) -> Zencell:
        started.append(Zencell(folder, domain, *arguments))
        return started[-1]

    yield start
    for command in started:
        for process in command.children().values():
            process.kill()
        command.process.kill()
        if command.process.stdout is not None and not command.process.stdout.closed:
            command.end()


def ask(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A zencell command that ends by itself."""
    return subprocess.run(
        command_line(*arguments), cwd=folder, env=environment(), capture_output=True, text=True, timeout=PATIENCE,
        check=False,
    )
