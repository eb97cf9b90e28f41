"""The system clock of a host is set while a cell runs: real processes that read it from a file."""

import signal
from pathlib import Path

import pytest

from common import topics
from common.messages import Image, JointState, MotionStatus
from tests.cells.test_watchdogs import restarted
from tests.harness import ROOT, RunningCell, until

pytestmark = [pytest.mark.cell, pytest.mark.slow]

# Runs first in every process of the cell.
FAKED = """
import time
from pathlib import Path
_time, _time_ns, _step = time.time, time.time_ns, Path({file!r})
time.time = lambda: _time() + float(_step.read_text())
time.time_ns = lambda: _time_ns() + int(1e9 * float(_step.read_text()))
"""


def halfway(status: MotionStatus) -> bool:
    return status.state == "active" and status.progress > 0.2


@pytest.mark.parametrize("step", [pytest.param(3600.0, marks=pytest.mark.campaign), -600.0])
async def test_restarted_service_keeps_cell_time_after_a_clock_step(tmp_path: Path, step: float) -> None:
    hook, file = tmp_path / "hook", tmp_path / "step"
    hook.mkdir()
    (hook / "sitecustomize.py").write_text(FAKED.format(file=str(file)))
    file.write_text("0")
    faked = {"PYTHONPATH": f"{ROOT}:{hook}"}
    with RunningCell(tmp_path, "run", "panda", "--set", "world.count=1", secrets=faked) as cell:
        async with cell.listen() as bus:
            supervisor, motion = bus.reader(topics.SUPERVISOR_STATUS), bus.reader(topics.MOTION_STATUS)
            joints, images = bus.reader(topics.JOINT_STATES), bus.reader(topics.CAMERA_IMAGE)
            await until(motion, halfway, 120)
            before: JointState = joints.latest
            file.write_text(str(step))
            for victim in ("trajectory_executor", "camera_simulator"):
                cell.processes()[victim].send_signal(signal.SIGKILL)
                await until(supervisor, lambda status, name=victim: restarted(name, status), 60)
            moving: MotionStatus = await until(motion, halfway, 60)
            picture: Image = await images.next()
            for message in (moving, picture, joints.latest):
                assert 0 < message.header.stamp - before.header.stamp < 300e9
            assert await cell.ended(180) == 0, cell.tail()
        assert cell.summary["state"] == "DONE" and cell.summary["restarts"]["trajectory_executor"] == 1
    assert "clock_ahead" not in cell.text and "stale_request" not in cell.text
