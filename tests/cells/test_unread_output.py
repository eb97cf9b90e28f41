"""Cells whose output is not read work, and stop on request."""

import fcntl
import os
import signal
from pathlib import Path

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from tests.cells.test_watchdogs import restarted
from tests.cli.conftest import make_folder
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
    with RunningCell(make_folder(tmp_path), "up", "tiny.yaml", *options, output=write) as cell:
        os.close(write)
        async with cell.listen() as bus:
            supervisor, status = bus.reader(topics.SUPERVISOR_STATUS), bus.reader(PICK_PLACE_STATUS)
            await until(supervisor, lambda status: all(one.state == "ready" for one in status.services))
            # The supervisor logs the end of the service, which is the task, and restarts it.
            first = await until(status, lambda one: one.started)
            cell.processes()["last"].send_signal(signal.SIGKILL)
            await until(supervisor, lambda status: restarted("last", status), 60)
            await until(status, lambda one: one.header.stamp > first.header.stamp)
        cell.process.send_signal(signal.SIGINT)
        assert await cell.ended(20) == 0
        assert not cell.processes()
    if kind == "full":
        os.close(read)
