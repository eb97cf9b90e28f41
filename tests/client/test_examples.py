"""The scripts, the notebook and the page of the Python client, run as a user runs them."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from common.client.blocking import Cell
from common.errors import ZencellError

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SAYS = {  # what a script prints among other lines
    "move": r"out_of_reach: .* reaches 1\.\d+ m\nthe tool is at 0\.\d+, -?0\.\d+, 0\.\d+ m",
    "pick": r"track_1 is grasped, 0\.06\d m wide",
    "look": r"camera: 640x480.*\n(track_\d at .* m, [0-4]\.\d mm off\n){4}",
    "task": r"paused at .*\nDONE: 2 of 2 in \d+\.\d s",
    "jog": r"the motion is .*\(script\).*\nstopped: stopped since .*\(lunch\)\n"
           r"the arm is not jogged: .*an operator enters",
    "listen": r"joints\.csv: \d{3} rows\ngoal .*\nheld: True",
    "tune": r"400 px: 3 seen\n800 px: 3 seen\n6400 px: 0 seen\nunknown parameter .*\nno message on .* only with 3 ",
    "world": r"ball_2 was added, 2 are seen\noff_table: .*\nball_2 is seen [0-4]\.\d mm from where it is\nleft: ball_1",
}

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.timeout(240)]  # jogging is a matter of 0.1 s


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working directory in which no process is left at the end."""
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert not processes_in(tmp_path)


def processes_in(folder: Path) -> list[psutil.Process]:
    """Return the processes with a working directory, except this one."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.pid != os.getpid() and Path(process.cwd()) == folder:
                found.append(process)
        except psutil.Error:
            continue
    return found


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=200, check=False)


def test_every_script_is_run_here_and_listed_in_the_readme() -> None:
    scripts = [path for path in EXAMPLES.glob("*.py") if path.stem != "conftest"]
    assert {path.stem for path in scripts} == set(SAYS)
    table = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert all(f"({path.name})" in table for path in [*scripts, *EXAMPLES.glob("*.ipynb")])


@pytest.mark.parametrize("name", sorted(SAYS))
def test_script_prints_its_result_and_ends_its_cell(name: str, folder: Path) -> None:
    done = run(EXAMPLES / f"{name}.py")
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert re.search(SAYS[name], done.stdout), done.stdout


def test_notebook_runs_from_top_to_bottom_inside_a_running_loop(folder, capsys):
    steps = json.loads((EXAMPLES / "tutorial.ipynb").read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}

    async def kernel() -> None:  # a notebook's kernel has a loop of its own
        for step in steps:
            if step["cell_type"] == "code":
                assert step["outputs"] == [] and step["execution_count"] is None
                exec("".join(step["source"]), names)

    asyncio.run(kernel())
    assert "out_of_reach" in capsys.readouterr().out
    assert names["held"].outcome == "grasped"  # type: ignore[attr-defined]


def test_code_of_the_page_runs_from_top_to_bottom(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = (EXAMPLES.parent / "docs" / "client.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert blocks
    names: dict[str, object] = {}
    for block in blocks:
        exec(block, names)
    assert "out_of_reach" in capsys.readouterr().out
    assert names["status"].state in ("DONE", "ERROR"), "the task was not stopped on its way"  # type: ignore[attr-defined]


SLOWLY = """
import threading
from zencell import pose
from zencell.blocking import Cell

def tell():
    next(status for status in cell.listen("motion/status") if status.state == "active" and status.progress > 0)
    print("moving", flush=True)

with Cell.start("panda") as cell:
    print("ready", flush=True)
    threading.Thread(target=tell).start()
    try:
        cell.arm.move(pose(0.3, 0.5, 0.3), speed=0.02)
    except KeyboardInterrupt:
        status = next(status for status in cell.listen("motion/status") if status.state != "active")
        print(status.state, abs(cell.arm.velocities()).max() < 0.01, flush=True)
        raise
"""


def start_slow_motion() -> subprocess.Popen[str]:
    script = subprocess.Popen([sys.executable, "-u", "-c", SLOWLY], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                              text=True)
    assert script.stdout is not None and script.stdout.readline() == "ready\n"
    return script


def test_ctrl_c_stops_the_arm_and_ends_the_cell(folder: Path) -> None:
    with start_slow_motion() as script:
        assert script.stdout is not None and script.stdout.readline() == "moving\n"
        script.send_signal(signal.SIGINT)
        out, err = script.communicate(timeout=60)
    assert out == "cancelled True\n", (out, err)
    assert err.rstrip().endswith("KeyboardInterrupt") and script.returncode != 0


def test_killed_script_takes_its_cell_with_it(folder: Path) -> None:
    with start_slow_motion() as script:
        assert processes_in(folder)
        script.kill()
    _, alive = psutil.wait_procs(processes_in(folder), timeout=60)
    assert not alive


def test_script_that_does_not_close_its_cell_ends_it_all_the_same(folder: Path) -> None:
    open_cell = "from zencell.blocking import Cell\ncell = Cell.start('panda').open()\n"
    done = run("-c", open_cell + "print(cell.arm.joints().shape)")
    assert (done.returncode, done.stdout, done.stderr) == (0, "(7,)\n", "")


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Cell.start("unknown"), "unknown cell 'unknown'"),
    (lambda: Cell.start("panda", overrides=["world.cuont=1"]), "world.cuont"),
    (lambda: Cell.start("panda", speed=99), "--speed"),
    (lambda: Cell("panda", domain=231), "zencell up"),
    (lambda: Cell("panda", domain=9999), "0 to 232"),
])
def test_cell_that_cannot_be_joined_has_a_reason(make: Callable[[], Cell], message: str, folder: Path) -> None:
    with pytest.raises(ZencellError, match=message), make():
        pass
