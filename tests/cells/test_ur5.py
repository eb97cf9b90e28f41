"""The UR5 cell from a terminal: snapshot, selection of an object, a prompt."""

import asyncio
import json
import os
import pty
import select
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest

from applications.outlining import stage_files
from applications.outlining.topics import CONTOUR_PATH, CONTOURS, OUTLINE_STATUS
from tests.harness import PATIENCE, Place, RunningCell, ask, command_line, environment, free_domain, until

pytestmark = [pytest.mark.cell, pytest.mark.slow]


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory):
    """A cell with three objects whose task waits."""
    arguments = ("--world", "w5", "--set", "autostart=false")
    with RunningCell(tmp_path_factory.mktemp("up"), "up", "ur5", *arguments) as cell:

        async def ready() -> None:
            async with cell.listen() as bus:
                await until(bus.reader(CONTOURS), lambda found: len(found.contours) == 3)

        asyncio.run(ready())
        yield cell


def test_snapshot_of_a_running_cell_can_be_planned_from_its_files(up: RunningCell, tmp_path: Path) -> None:
    stored = Place(tmp_path, up.domain).ask("snapshot", "ur5", str(tmp_path), "--select", "green")
    assert stored.returncode == 0, stored.stderr
    names = {"camera_image.png", "depth_camera_image.png", "depth_camera_image_normalized.png", "depth_data.npy",
             "relevant_contours_pixels.json", "relevant_contours_coordinates.json",
             "relevant_contours_cleared_coordinates.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    center = stage_files.read_coordinates(tmp_path / stage_files.CLEARED).mean(axis=0)
    assert center == pytest.approx((0.46, -0.12, 1.05), abs=0.02)
    (tmp_path / stage_files.PIXELS).unlink()
    offline = ask(tmp_path, "outline", str(tmp_path), "--world", "w5", "--select", "green")
    assert offline.returncode == 0, offline.stderr
    stages = [line.split()[0] for line in offline.stdout.splitlines()[1:]]
    assert stages == ["approach", "descend", "trace", "retreat", "home"]
    assert {path.name for path in tmp_path.iterdir()} == names


def test_missing_object_is_rejected_with_choices_and_another_is_selected(up: RunningCell, tmp_path: Path) -> None:
    place = Place(tmp_path, up.domain)
    missing, nonsense = place.ask("task", "select", "7"), place.ask("task", "select", "purple")
    assert missing.returncode == 1 and "there is no contour 7; choices: 0 (Object_0, " in missing.stderr
    assert nonsense.returncode == 2 and "choices:" in nonsense.stderr
    label = json.loads("\n".join(place.say("task", "select", "red")))["label"]

    async def start() -> None:
        async with up.listen() as bus:
            await until(bus.reader(CONTOUR_PATH), lambda path: path.object == label)
            await asyncio.to_thread(place.say, "task", "start")
            await until(bus.reader(OUTLINE_STATUS), lambda s: s.object == label and s.stage == "approach", 60)

    asyncio.run(start())
    up.interrupt()
    assert asyncio.run(up.ended(PATIENCE)) == 0
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
        with suppress(OSError):  # the other side is closed
            while time.monotonic() < deadline:
                if select.select([terminal], [], [], 1.0)[0]:
                    text += os.read(terminal, 65536)
                if answers and text.count(b"outline which one?") > 2 - len(answers):
                    os.write(terminal, answers.pop(0))
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    finally:
        os.close(terminal)
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
    output = text.decode(errors="replace")
    assert code == 0, output[-3000:]
    for expected in ("there is no contour 7; choices: 0 (Object_0, ", "ur5: DONE, Object_1 outlined",
                     str(tmp_path / "ur5_contours.png")):
        assert expected in output
    assert stage_files.read_picture(tmp_path / "ur5_contours.png").shape == (768, 1024, 3)
