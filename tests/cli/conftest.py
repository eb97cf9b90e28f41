"""A package of tiny services, a cell made of them, and the real command around it."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.harness import Zencell, free_domain

SERVICE = '''"""A tiny service."""
import asyncio, os, sys
from applications.pick_place.topics import PICK_PLACE_STATUS
from applications.pick_place.topics import PickPlaceStatus
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
        raise ConfigError("behave", config.behave, "cannot be done")
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
from common.messages import Image, Interlock, MotionStatus, TaskStatus
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
    async def stop(request):
        lost = Interlock(kind="stopped", by="anna", reason="not saved on disk (it is full)", since=1)
        return MotionStatus(header=bus.header(), interlocks=[lost])
    images = bus.writer(topics.CAMERA_IMAGE)
    bus.serve(topics.TASK_COMMAND, answer)
    bus.serve(topics.MOTION_STOP, stop)
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


@pytest.fixture(autouse=True)
def _forget_services_of_other_folders(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Modules of one test's folder are not found by another's, which may run in the same process."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "fakes"]:
        del sys.modules[name]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of its own for each test."""
    return make_folder(tmp_path)


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    """Each test that runs a command in this process finds the services of its own folder, not those of another."""
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "fakes"]:
        del sys.modules[name]


@pytest.fixture
def domain() -> int:
    """A domain of its own for each test."""
    return free_domain()


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
