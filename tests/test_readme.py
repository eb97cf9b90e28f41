"""Run the commands of the README and of two further pages literally, except for the port.

One run per application uses real processes; the others run on the virtual clock.
"""

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import pages
from tests.harness import Place, ask, free_domain, place_of
from tests.simulated.visited import no_processes

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
PAGES = ("README.md", "docs/tools.md", "docs/outlining.md")
LINES = [*dict.fromkeys(line.removeprefix(".venv/bin/") for page in PAGES for line in pages.lines(pages.text_of(page)))]
RUNS = [line for line in LINES if line.startswith("zencell run")]
WITH_CELL = [line for line in LINES if line.startswith("zen") and line not in RUNS and " up " not in line]
AS_PROCESSES = [next(line for line in RUNS if f" {cell} " in line) for cell in ("panda", "ur5")]
IN_OTHER_TESTS = [f"zencell run {cell}" for cell in ("duo", "conveyor", "handover", "tending", "insertion")]
TIMEOUT = 60  # [s]


def command(line: str, *more: str) -> list[str]:
    program, *words = shlex.split(line)
    return [f"{BIN}/{program}", *words, *more]


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """Start the README's `up` cell, without its page."""
    line = next(line for line in LINES if " up " in line)
    with place_of(tmp_path_factory.mktemp("up"), *shlex.split(line)[2:], "--no-viewer") as place:
        yield place


def assert_all_done(line: str, ran: subprocess.CompletedProcess[str]) -> None:
    count = next((count for count in ("2", "8") if f"count={count}" in shlex.join(ran.args)), "7")
    others = {
        " ur5 ": "outlined: 100.0%",
        " sorting": "sorting: DONE, ",  # how many of a heap are sorted is measured by benchmarks.grasping
        " examples/programs/": "panda: DONE, 11 of 11 done",
        " policy_panda": "policy_panda: DONE, ",  # the learned policy picks 94 of 100 balls; this is one of them
    }
    wanted = next((text for word, text in others.items() if word in line),
                  f"DONE, {count} of {count} placed (truth: {count} in the box, 0 on the table)")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert wanted in ran.stdout


@pytest.mark.slow
@pytest.mark.cell
@pytest.mark.parametrize("line", AS_PROCESSES)
def test_run_of_the_readme_ends_done(line: str) -> None:
    shorter = () if "--speed" in line else ("--speed", "10")
    shorter += ("--set", "world.count=2") if " panda " in line else ()
    assert_all_done(line, subprocess.run(
        command(line, *shorter, "--domain", str(free_domain())), cwd=ROOT, text=True, capture_output=True,
        timeout=2 * TIMEOUT, check=False))


@pytest.mark.slow
@pytest.mark.parametrize("line", [line for line in RUNS if line not in AS_PROCESSES + IN_OTHER_TESTS])
def test_simulated_run_of_the_readme_ends_done(line: str, tmp_path: Path) -> None:
    shorter = ()
    if " sorting" in line:
        pytest.importorskip("mujoco")
        shorter = ("--set", "world.generator.count=3")
    with no_processes():
        words = [str(ROOT / word) if word.startswith("examples/") else word for word in command(line)[1:]]
        assert_all_done(line, ask(tmp_path, *words, *shorter, "--domain", str(free_domain())))


@pytest.mark.slow
@pytest.mark.cell
@pytest.mark.parametrize("line", WITH_CELL)
def test_command_of_the_readme_works_with_a_running_cell(line: str, cell: Place) -> None:
    line, variables = line.replace("7489", str(7447 + cell.domain)), {"ZENCELL_DOMAIN": str(cell.domain)}
    assert not line.startswith("zenoh ") or line in cell.started[0].lines, "`zencell up` prints it"
    if line.startswith("zenoh ") or ("topic echo" in line and "--count" not in line):  # until Ctrl-C
        with subprocess.Popen(command(line), cwd=cell.folder, env=os.environ | variables, text=True,
                              stdout=subprocess.PIPE) as process:
            output = process.stdout.readline()
            process.send_signal(signal.SIGINT)
    else:
        ran = ask(cell.folder, *shlex.split(line)[1:], environment=variables)
        assert ran.returncode == 0, ran.stderr
        output = ran.stdout
    wanted = {"hz": "Hz", "status": '"state"', "targets": '"poses"', "list": "panda/", "zenoh": "panda/",
              "add": '"ids"', "pause": '"paused": true', " top ": "panda at speed", " tf ": "position",
              "param set": "400.0 -> 350.0", "param dump": "# Parameters of panda", "record": "",
              "--save mask.png": "mono8"}
    assert next(text for word, text in wanted.items() if word in line) in output.partition("\n")[0]
