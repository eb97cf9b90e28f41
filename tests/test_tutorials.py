"""Execute the tutorials literally and in order, and compare their output with the pages.

Tutorials that inspect a cell share a running one; commands that start a cell use the virtual clock.
"""

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import pages
from tests.harness import Place, ask, environment, free_domain, place_of
from tests.simulated.visited import no_processes

TIMEOUT = 100  # [s]
CELL = "zencell up panda --set autostart=false --set world.count=3"
REAL = "real-arm"
NAMES = [path.stem for path in pages.TUTORIALS]
TEXTS = {path.stem: path.read_text(encoding="utf-8") for path in pages.TUTORIALS}
NOT_RUN = {  # these set up the machine, or need an arm; a test starts the double
    "first-run": {"make setup"},
    REAL: {"make setup EXTRAS=ur", "zencell up my_cell.yaml --set autostart=false", "zencell robot enable",
           "zencell task home",
           "python -m tests.doubles.ur_controller --host 127.0.0.2 --off --q 0,-2.36,1.57,-1.57,-1.57,0"},
}

pytestmark = [pytest.mark.slow, pytest.mark.cell, pytest.mark.timeout(600)]  # a page is several runs of a cell


def test_unexecuted_commands_are_listed() -> None:
    assert {name: set(lines) for name, text in TEXTS.items() if (lines := pages.lines(text, "console"))} == NOT_RUN
    assert all(line == CELL for name, text in TEXTS.items() if name != REAL
               for line in pages.lines(text, "sh") if line.startswith("zencell up "))


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """Start the cell of most tutorials, without its page."""
    folder = tmp_path_factory.mktemp("up")
    with place_of(folder, *shlex.split(CELL)[2:], "--no-viewer") as place:
        yield place


def follow(name: str, folder: Path, domain: int) -> list[str]:
    """Execute a tutorial except the command that starts its cell; return the executed commands."""
    for file, text in pages.files(TEXTS[name]).items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text, encoding="utf-8")
    done = []
    for step in pages.steps(TEXTS[name], "sh"):
        if not step.line.startswith("zencell up "):
            ran = execute(step.line, folder, domain)
            deadline = time.monotonic() + TIMEOUT
            while time.monotonic() < deadline and (
                ("robot status" in step.line and not step.shown_in(ran.stdout))  # an arm needs time
                or ("robot " in step.line and ran.returncode and not step.shows)  # a delay stopped the arm
            ):
                ran = execute(step.line, folder, domain)
            output = ran.stdout + ran.stderr
            assert step.shown_in(output), (step, output)
            assert ran.returncode == 0 or step.shows.startswith("zencell:"), (step, output)  # the page shows the error
            done.append(step.line)
    return done


def execute(line: str, folder: Path, domain: int) -> subprocess.CompletedProcess[str]:
    """Execute a command of a tutorial; a cell that it starts runs without processes in its own domain."""
    program, *words = shlex.split(line)
    if program == "python":
        variables = {**environment(folder), "ZENCELL_DOMAIN": str(domain)}
        return subprocess.run([sys.executable, *words], cwd=folder, env=variables, text=True, capture_output=True,
                              timeout=TIMEOUT, check=False)
    assert program == "zencell", line
    with no_processes():
        return ask(folder, *words, environment={"ZENCELL_DOMAIN": str(free_domain() if words[0] == "run" else domain)})


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[pytest.mark.alone] if "robot jog" in TEXTS[name] else [])  # timing of 0.1 s
    for name in NAMES if name != REAL and CELL in TEXTS[name]])
def test_tutorial_with_a_running_cell_prints_what_it_states(name: str, up: Place, tmp_path: Path) -> None:
    assert follow(name, tmp_path, up.domain)


@pytest.mark.parametrize("name", [name for name in NAMES if name != REAL and CELL not in TEXTS[name]])
def test_tutorial_without_a_cell_prints_what_it_states(name: str, tmp_path: Path) -> None:
    assert follow(name, tmp_path, free_domain())


@pytest.mark.alone
def test_real_arm_tutorial_prints_what_it_states_with_a_double(tmp_path: Path) -> None:
    if os.environ.get("CI") != "true":
        pytest.importorskip("rtde_control", reason="make setup EXTRAS=ur")
    line = next(line for line in pages.lines(TEXTS[REAL], "sh") if line.startswith("zencell up "))
    double = next(line for line in NOT_RUN[REAL] if line.startswith("python "))
    with subprocess.Popen([sys.executable, *shlex.split(double)[1:]], cwd=pages.ROOT) as arm:
        try:
            with place_of(tmp_path, *shlex.split(line)[2:], "--no-viewer") as place:
                assert follow(REAL, tmp_path, place.domain)
        finally:
            arm.terminate()
