"""Cells whose output is not read work, and stop on request."""

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
    """Return a pipe whose buffer is full."""
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


@pytest.mark.parametrize(("kind", "options"), [
    ("full", ()), ("dead", ("--log-json",)),
    *(pytest.param(*one, marks=pytest.mark.campaign) for one in (("full", ("--log-json",)), ("dead", ())))])
async def test_cell_with_unread_output_works_and_can_be_stopped(
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
            # The supervisor logs the end of the service and restarts it.
            cell.processes()["vision_detector"].send_signal(signal.SIGKILL)
            await until(supervisor, lambda status: restarted("vision_detector", status), 60)
            await until(motion, halfway, 60)
        cell.process.send_signal(signal.SIGINT)
        assert await cell.ended(20) == 0
        assert not cell.processes()
    if kind == "full":
        os.close(read)
