"""`zencell simulate`: campaigns, and one seed in full."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from cli.main import app
from common.errors import ConfigError
from lab.campaign import format_counts, seeds_of
from recording.reader import Recording
from tests.harness import ROOT, command_line

pytestmark = pytest.mark.timeout(600)  # some seconds of work, on a machine that may be busy
SMALL = ["panda", "--set", "world.count=1"]


@pytest.mark.slow
def test_campaign_counts_faults_and_checked_invariants(capfd):
    code = app.execute(["simulate", *SMALL, "--seeds", "1-2", "--faults", "--doubles", "--jobs", "2"])
    table = capfd.readouterr().out
    assert code == 0 and "2 of 2 (100.0%)" in table, table
    crashes = re.search(r"fault: crash +│ (\d+) ", table)
    assert crashes and int(crashes[1]) >= 6
    for row in ("fault: lost", "fault: duplicated", "invariant: one goal at a time", "invariant: a goal id acts once"):
        assert row in table


@pytest.mark.slow
def test_no_module_but_drivers_needs_an_extra():
    imports = """
import importlib, pathlib, sys
sys.modules |= dict.fromkeys(("mujoco", "OpenGL", "rtde_control", "pylibfranka", "pyrealsense2", "depthai"))
for folder in ("applications", "cli", "common", "lab", "page", "recording", "security", "services", "tools", "zencell"):
    for path in pathlib.Path(folder).rglob("*.py"):
        if path.stem != "__main__" and path.parent.name != "learning":  # its parts with physics: `zencell grasp` only
            importlib.import_module(".".join(path.with_suffix("").parts).removesuffix(".__init__"))
"""
    done = subprocess.run([sys.executable, "-c", imports], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_campaign_that_exceeds_its_limit_names_each_seed_and_fails(capfd):
    assert app.execute(["simulate", *SMALL, "--seeds", "4-5", "--limit", "3"]) == 1
    table = capfd.readouterr().out
    assert "seed 4" in table and "seed 5" in table and "NOT ENDED" in table


@pytest.mark.slow
def test_one_seed_is_reported_and_recorded(tmp_path, capfd):
    file = tmp_path / "seed.mcap"
    assert app.execute(["simulate", *SMALL, "--seed", "7", "--faults", "--trace", str(file)]) == 0
    text = capfd.readouterr().out
    assert "FAULT crash" in text and "seed 7: DONE" in text and "digest" in text
    with Recording(file) as recording:
        keys = {sample.key for sample in recording.samples()}
    assert {"panda/joint_states", "panda/pick_place_status", "panda/camera/image_raw",
            "panda/log/smart_pick_place"} <= keys
    assert app.execute(["info", str(file), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["messages"] > 1000
    assert app.execute(["report", str(file), "-o", str(tmp_path / "seed.html")]) == 0
    assert (tmp_path / "seed.html").stat().st_size > 10_000


@pytest.mark.slow
def test_interrupted_campaign_prints_its_results_and_leaves_no_process():
    command = command_line("simulate", *SMALL, "--seeds", "1-500", "--jobs", "2", "--limit", "5")
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               start_new_session=True)
    try:
        assert running.stderr is not None and "NOT ENDED" in running.stderr.readline()
        running.send_signal(signal.SIGINT)
        table, errors = running.communicate(timeout=60.0)
        assert running.returncode == 130, errors
        assert "Traceback" not in errors and "leaked" not in errors
        assert "interrupted after" in errors and "DONE" in table
        deadline = time.monotonic() + 20.0
        with suppress(ProcessLookupError):
            while time.monotonic() < deadline:
                os.killpg(running.pid, 0)
                time.sleep(0.05)
            pytest.fail("a process of the campaign is left")
    finally:
        running.kill()


def test_seeds_are_a_range_or_one_and_counts_are_sorted():
    assert list(seeds_of("3-5")) == [3, 4, 5] and list(seeds_of("8")) == [8]
    with pytest.raises(ConfigError):
        seeds_of("1-")
    assert format_counts({"a": 1, "b": 2000}) == "b 2,000, a 1"
