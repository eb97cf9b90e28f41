"""Frozen processes of a cell are restarted, and no others."""

import signal
from pathlib import Path

import pytest

from common import topics
from common.messages import SupervisorStatus
from tests.cli.conftest import make_folder
from tests.harness import RunningCell, until

pytestmark = [pytest.mark.cell, pytest.mark.slow]


def restarted(name: str, status: SupervisorStatus) -> bool:
    return any(s.name == name and s.restarts > 0 and s.state == "ready" for s in status.services)


async def test_frozen_processes_and_no_others_are_restarted(tmp_path: Path) -> None:
    with RunningCell(make_folder(tmp_path), "up", "tiny.yaml", "--set", "watchdogs.silence=4") as cell:
        async with cell.listen() as bus:
            supervisor = bus.reader(topics.SUPERVISOR_STATUS)
            await until(supervisor, lambda status: all(one.state == "ready" for one in status.services))
            for victim in ("middle", "router"):
                cell.processes()[victim].send_signal(signal.SIGSTOP)
                await until(supervisor, lambda status, name=victim: restarted(name, status), 60)
        cell.interrupt()
        assert await cell.ended(20) == 0, cell.tail()
        summary = cell.summary
        assert not cell.processes()
    assert {name: n for name, n in summary["restarts"].items() if n} == {"middle": 1, "router": 1}
    assert "middle has sent nothing for" in cell.text and "router does not answer for" in cell.text
