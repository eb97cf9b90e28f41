"""Complete cells on the virtual clock: every service's own code, from the start to the end of the task."""

import os
import subprocess
import sys

import pytest

from common.config import load_cell
from lab.simulation import Simulation
from tests.harness import ROOT
from tests.simulated.visited import SimulatedCell, in_box

DIGEST = """
import sys
from common.config import load_cell
from lab.simulation import Simulation
print(Simulation(load_cell(sys.argv[1], sys.argv[3:]), int(sys.argv[2]), digest=True).run().digest)
"""


def test_panda_clears_the_table():
    summary = SimulatedCell("panda", ["world.count=2"]).summary
    assert (summary["state"], summary["placed"], summary["targets"], summary["rejected"]) == ("DONE", 2, 2, [])
    assert (summary["truth"], summary["restarts"]) == (in_box(2), {})
    assert len(summary["plans"]) >= 4 and (summary["failures"], summary["retries"]) == (0, 0)
    assert (summary["overlooked"], summary["unexplained"]) == ("", [])


@pytest.mark.parametrize(("cell", "overrides"), [
    ("panda", ["world.count=1"]), pytest.param("ur5", [], marks=pytest.mark.campaign)])
@pytest.mark.slow
def test_same_seed_gives_the_same_bytes_in_any_process(cell, overrides):
    here = Simulation(load_cell(cell, overrides), 3, digest=True).run()
    assert here.messages > 1000
    other_process = subprocess.run(
        [sys.executable, "-c", DIGEST, cell, "3", *overrides], cwd=ROOT, env={**os.environ, "PYTHONHASHSEED": "7"},
        capture_output=True, text=True, check=True)
    assert other_process.stdout.strip() == here.digest
    assert Simulation(load_cell(cell, overrides), 4, digest=True).run().digest != here.digest


def test_task_that_does_not_end_is_reported_with_its_state():
    outcome = Simulation(load_cell("panda", ["autostart=false", "world.count=1"]), 1, limit=6.0).run()
    assert outcome.state == "NOT ENDED" and "IDLE" in outcome.message
