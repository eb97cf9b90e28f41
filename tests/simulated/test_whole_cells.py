"""Whole cells on the virtual clock: every service's own code, from the start to the end of the task."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from common.config import load_cell
from lab.simulation import Simulation
from tests.simulated.visited import SimulatedCell

pytestmark = pytest.mark.timeout(600)  # some seconds of work, on a machine that may be busy
ROOT = Path(__file__).resolve().parents[2]
DIGEST = """
import sys
from common.config import load_cell
from lab.simulation import Simulation
print(Simulation(load_cell(sys.argv[1], sys.argv[3:]), int(sys.argv[2]), digest=True).run().digest)
"""


def digest_in_another_process(hash_seed: int, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", DIGEST, *arguments], cwd=ROOT, env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
        capture_output=True, text=True, check=True,
    )
    return done.stdout.strip()


def test_panda_clears_the_table_in_no_wall_time():
    summary = SimulatedCell("panda").summary
    assert (summary["state"], summary["placed"], summary["targets"], summary["rejected"]) == ("DONE", 7, 7, [])
    assert summary["truth"] == {"in_box": 7, "on_table": 0, "elsewhere": 0, "containers": {"box": 7}}
    assert len(summary["plans"]) >= 2 * 7 and (summary["failures"], summary["retries"]) == (0, 0)
    assert summary["restarts"] == {}


@pytest.mark.parametrize(("cell", "overrides"), [
    ("panda", ["world.count=1"]), pytest.param("ur5", [], marks=pytest.mark.slow),
])
@pytest.mark.slow
def test_same_seed_gives_the_same_bytes_in_any_process(cell, overrides):
    here = Simulation(load_cell(cell, overrides), 3, digest=True).run()
    assert here.messages > 1000
    assert digest_in_another_process(7, cell, "3", *overrides) == here.digest
    other = Simulation(load_cell(cell, overrides), 4, digest=True).run()
    assert other.digest != here.digest, "another seed is another run"


def test_task_that_does_not_end_is_reported_with_its_state():
    outcome = Simulation(load_cell("panda", ["autostart=false", "world.count=1"]), 1, limit=6.0).run()
    assert outcome.state == "NOT ENDED" and "IDLE" in outcome.message
