"""The UR5 cell from a terminal: snapshot, selection of an object, a question."""

from __future__ import annotations

import asyncio
import json
import os
import pty
import select
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from applications.outlining import stage_files
from applications.outlining.topics import CONTOUR_PATH, CONTOURS, OUTLINE_STATUS
from common import topics
from common.config import load_cell
from common.messages import SupervisorStatus
from tests.harness import RunningCell, command_line, environment, free_domain, until

pytestmark = [pytest.mark.cell, pytest.mark.slow]

SERVICES = [name for name in load_cell("ur5").services if name != "viewer"]


def all_ready(status: SupervisorStatus) -> bool:
    return len(status.services) == 1 + len(SERVICES) and all(service.state == "ready" for service in status.services)


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCell]:
    """A cell with three objects whose task waits."""
    arguments = ("--world", "w5", "--set", "autostart=false")
    with RunningCell(tmp_path_factory.mktemp("up"), "up", "ur5", *arguments) as cell:

        async def ready() -> None:
            async with cell.listen() as bus:
                await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready)
                await until(bus.reader(CONTOURS), lambda found: len(found.contours) == 3)

        asyncio.run(ready())
        yield cell


def test_snapshot_of_a_running_cell_can_be_planned_from_its_files(up: RunningCell, tmp_path: Path) -> None:
    stored = up.command("snapshot", "ur5", str(tmp_path), "--select", "green")
    assert stored.returncode == 0, stored.stderr
    names = {"camera_image.png", "depth_camera_image.png", "depth_camera_image_normalized.png", "depth_data.npy",
             "relevant_contours_pixels.json", "relevant_contours_coordinates.json",
             "relevant_contours_cleared_coordinates.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    x, y, z = stage_files.read_coordinates(tmp_path / stage_files.CLEARED).mean(axis=0)
    assert (x, y, z) == pytest.approx((0.46, -0.12, 1.05), abs=0.02)
    (tmp_path / stage_files.PIXELS).unlink()
    command = command_line("outline", str(tmp_path), "--world", "w5", "--select", "green")
    offline = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60, check=False)
    assert offline.returncode == 0, offline.stderr
    assert [line.split()[0] for line in offline.stdout.splitlines()[1:]] == [
        "approach", "descend", "trace", "retreat", "home"]
    assert {path.name for path in tmp_path.iterdir()} == names


def test_missing_object_is_rejected_with_choices_and_another_is_selected(up: RunningCell) -> None:
    refused = up.command("task", "select", "7")
    assert refused.returncode == 1
    assert "there is no contour 7; choices: 0 (Object_0, " in refused.stderr
    nonsense = up.command("task", "select", "purple")
    assert nonsense.returncode == 2 and "choices:" in nonsense.stderr
    chosen = up.command("task", "select", "red")
    assert chosen.returncode == 0, chosen.stderr
    label = json.loads(chosen.stdout)["label"]

    async def begin() -> None:
        async with up.listen() as bus:
            await until(bus.reader(CONTOUR_PATH), lambda path: path.object == label)
            started = up.command("task", "start")
            assert started.returncode == 0, started.stderr
            status = bus.reader(OUTLINE_STATUS)
            await until(status, lambda s: s.object == label and s.stage == "approach", 60)

    asyncio.run(begin())
    up.interrupt()
    assert asyncio.run(up.ended(10)) == 0
    assert up.summary["outline"]["object"] == label


def test_terminal_user_selects_an_object_from_an_image(tmp_path: Path) -> None:
    domain = str(free_domain())
    command = command_line("run", "ur5", "--ask", "--world", "w5", "--speed", "10", "--no-viewer", "--domain", domain)
    child, terminal = pty.fork()
    if child == 0:
        os.chdir(tmp_path)
        os.execvpe(command[0], command, environment())
    answers, text, deadline = [b"7\n", b"red\n"], b"", time.monotonic() + 110
    try:
        while time.monotonic() < deadline:
            readable, _, _ = select.select([terminal], [], [], 1.0)
            with suppress(OSError):  # the other side is closed
                new = os.read(terminal, 65536) if readable else b"."
                text += new if readable else b""
                if answers and text.count(b"outline which one?") > 2 - len(answers):
                    os.write(terminal, answers.pop(0))
                continue
            break
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    finally:
        os.close(terminal)
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
    said = text.decode(errors="replace")
    assert code == 0, said[-3000:]
    assert "there is no contour 7; choices: 0 (Object_0, " in said
    assert "ur5: DONE, Object_1 outlined" in said
    assert str(tmp_path / "ur5_contours.png") in said
    assert stage_files.read_picture(tmp_path / "ur5_contours.png").shape == (768, 1024, 3)
