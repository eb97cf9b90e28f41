"""Frozen processes of a complete cell are restarted, and no others."""

import signal
from pathlib import Path

import pytest

from common import topics
from common.messages import MotionStatus, SupervisorStatus
from tests.harness import RunningCell, until
from tests.simulated.visited import in_box

pytestmark = [pytest.mark.cell, pytest.mark.slow]


def restarted(name: str, status: SupervisorStatus) -> bool:
    return any(s.name == name and s.restarts > 0 and s.state == "ready" for s in status.services)


def halfway(status: MotionStatus) -> bool:
    return status.state == "active" and status.progress > 0.2


async def test_frozen_processes_and_no_others_are_restarted(tmp_path: Path) -> None:
    options = ("--speed", "3", "--set", "world.count=2", "--set", "watchdogs.silence=4")
    with RunningCell(tmp_path, "run", "panda", *options) as cell:
        async with cell.listen() as bus:
            supervisor, motion = bus.reader(topics.SUPERVISOR_STATUS), bus.reader(topics.MOTION_STATUS)
            for victim in ("vision_detector", "router"):
                await until(motion, halfway, 60)
                cell.processes()[victim].send_signal(signal.SIGSTOP)
                await until(supervisor, lambda status, name=victim: restarted(name, status), 60)
            assert await cell.ended(120) == 0, cell.tail()
        summary = cell.summary
        assert not cell.processes()
    assert {name: n for name, n in summary["restarts"].items() if n} == {"vision_detector": 1, "router": 1}
    assert "vision_detector has sent nothing for" in cell.text and "router does not answer for" in cell.text
    assert (summary["state"], summary["truth"]) == ("DONE", in_box(2))
