"""Nobody reads what a cell says, on a pipe that is full or dead: it works, and ends when it is told to."""

from __future__ import annotations

import fcntl
import os
import signal
from pathlib import Path

import pytest

from common import topics
from tests.cells.test_watchdogs import halfway, restarted
from tests.harness import RunningCell, until

pytestmark = [pytest.mark.cell, pytest.mark.slow]


def full_pipe() -> tuple[int, int]:
    """A pipe that takes nothing more."""
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    os.set_blocking(write, False)
    while True:
        try:
            os.write(write, b"x" * 64)
        except BlockingIOError:
            break
    os.set_blocking(write, True)
    return read, write


@pytest.mark.parametrize("kind", ["full", "dead"])
@pytest.mark.parametrize("options", [(), ("--log-json",)])
async def test_cell_whose_lines_nobody_reads_works_and_can_be_ended(
    tmp_path: Path, kind: str, options: tuple[str, ...]
) -> None:
    read, write = full_pipe()
    if kind == "dead":
        os.close(read)
    with RunningCell(tmp_path, "up", "panda", "--set", "world.count=2", *options, output=write) as cell:
        os.close(write)
        async with cell.listen() as bus:
            supervisor, motion = bus.reader(topics.SUPERVISOR_STATUS), bus.reader(topics.MOTION_STATUS)
            await until(motion, halfway, 120)
            cell.processes()["vision_detector"].send_signal(signal.SIGKILL)  # which the supervisor says, and mends
            await until(supervisor, lambda status: restarted("vision_detector", status), 60)
            await until(motion, halfway, 60)
        cell.process.send_signal(signal.SIGINT)
        assert await cell.ended(20) == 0
        assert not cell.processes()
    if kind == "full":
        os.close(read)
