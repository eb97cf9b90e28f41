"""The scripts and the notebook of examples/, as a person runs them."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SAYS = {  # what a script prints among other lines
    "move": r"out_of_reach: .* reaches 1\.\d+ m\nthe tool is at 0\.\d+, -?0\.\d+, 0\.\d+ m",
    "pick": r"track_1 is grasped, 0\.06\d m wide",
    "look": r"camera: 640x480.*\n(track_\d at .* m, [0-4]\.\d mm off\n){4}",
    "task": r"paused at .*\nDONE: 2 of 2 in \d+\.\d s",
    "jog": r"the motion is .*\(script\).*\nstopped: stopped since .*\(lunch\)\n"
           r"the arm is not jogged: .*an operator enters",
    "listen": r"joints\.csv: \d{3} rows\ngoal .*\nheld: True",
    "tune": r"400 px: 3 seen\n800 px: 3 seen\n6400 px: 0 seen\nunknown parameter .*\nnothing came on .* only with 3 ",
    "world": r"ball_2 was added, 2 are seen\noff_table: .*\nball_2 is seen [0-4]\.\d mm from where it is\nleft: ball_1",
}

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.timeout(240)]  # jogging is a matter of 0.1 s


def test_every_script_is_run_here_and_listed_for_people() -> None:
    scripts = [path for path in EXAMPLES.glob("*.py") if path.stem != "conftest"]
    assert {path.stem for path in scripts} == set(SAYS)
    table = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert all(f"({path.name})" in table for path in [*scripts, *EXAMPLES.glob("*.ipynb")])


@pytest.mark.parametrize("name", sorted(SAYS))
def test_script_prints_what_it_found_and_leaves_nothing_behind(name: str, tmp_path: Path) -> None:
    command = [sys.executable, EXAMPLES / f"{name}.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert re.search(SAYS[name], done.stdout), done.stdout
    assert not left(tmp_path)


def left(folder: Path) -> list[psutil.Process]:
    """Processes that were begun in a folder, but for this one."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.pid != os.getpid() and Path(process.cwd()) == folder:
                found.append(process)
        except psutil.Error:
            continue
    return found


def test_notebook_runs_from_top_to_bottom_inside_a_loop_that_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    steps = json.loads((EXAMPLES / "tutorial.ipynb").read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}

    async def kernel() -> None:  # a notebook's kernel has a loop of its own
        for step in steps:
            if step["cell_type"] == "code":
                assert step["outputs"] == [] and step["execution_count"] is None
                exec("".join(step["source"]), names)

    asyncio.run(kernel())
    assert "out_of_reach" in capsys.readouterr().out
    assert names["held"].outcome == "grasped" and not left(tmp_path)  # type: ignore[attr-defined]


@pytest.mark.parametrize(("page", "says"), [("docs/client.md", "out_of_reach")])
def test_what_a_page_says_works_from_top_to_bottom(
    page: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (EXAMPLES.parent / page).read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    names: dict[str, object] = {}
    for block in blocks:
        exec(block, names)
    assert says in capsys.readouterr().out and not left(tmp_path)
    assert names["status"].state in ("DONE", "ERROR"), "the task was not stopped on its way"  # type: ignore[attr-defined]


SLOWLY = """
import time

from zencell import pose
from zencell.blocking import Cell

with Cell.start("panda") as cell:
    print("ready", flush=True)
    try:
        cell.arm.move(pose(0.3, 0.5, 0.3), speed=0.02)
    except KeyboardInterrupt:
        time.sleep(0.5)  # in which it comes to rest
        status = cell.arm.status()
        print(status.state, abs(cell.arm.velocities()).max() < 0.01, flush=True)
        raise
"""


def test_ctrl_c_stops_the_arm_and_ends_the_cell(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SLOWLY], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as script:
        assert script.stdout is not None and script.stdout.readline() == "ready\n"
        with pytest.raises(subprocess.TimeoutExpired):
            script.wait(3.0)  # it moves for longer
        script.send_signal(signal.SIGINT)
        out, told = script.communicate(timeout=60)
    assert out == "cancelled True\n", (out, told)
    assert told.rstrip().endswith("KeyboardInterrupt") and script.returncode != 0 and not left(tmp_path)


def test_a_script_that_is_killed_takes_its_cell_with_it(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SLOWLY], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as script:
        assert script.stdout is not None and script.stdout.readline() == "ready\n" and left(tmp_path)
        script.kill()
    _, alive = psutil.wait_procs(left(tmp_path), timeout=60)
    assert not alive


def test_a_script_that_forgets_its_cell_ends_it_all_the_same(tmp_path: Path) -> None:
    script = "from zencell.blocking import Cell\ncell = Cell.start('panda').open()\nprint(cell.arm.joints().shape)"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "(7,)\n", "") and not left(tmp_path)


def test_a_cell_that_does_not_come_up_says_why(tmp_path: Path) -> None:
    for asked, words in (
        ('Cell.start("nobody")', "unknown cell 'nobody'"),
        ('Cell.start("panda", overrides=["world.cuont=1"])', "world.cuont"),
        ('Cell.start("panda", speed=99)', "--speed"),
        ('Cell("panda", domain=231)', "zencell up"),
        ('Cell("panda", domain=9999)', "0 to 232"),
    ):
        script = f"from zencell.blocking import Cell\nwith {asked} as cell: pass"
        done = subprocess.run(
            [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == 1 and words in done.stderr.splitlines()[-1], (asked, done.stderr)
        assert not left(tmp_path)
