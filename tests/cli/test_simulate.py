"""`zencell simulate`: campaigns, one seed in full, and what it cannot do."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cli.main import app
from common.errors import ConfigError
from lab.campaign import format_counts, seeds_of
from recording.reader import Recording

pytestmark = pytest.mark.timeout(600)  # some seconds of work, on a machine that may be busy
SMALL = ["panda", "--set", "world.count=1"]


def test_campaign_with_faults_tells_what_was_made_and_checked(capfd):
    code = app.execute(["simulate", *SMALL, "--seeds", "1-2", "--faults", "--doubles", "--jobs", "2"])
    told = capfd.readouterr().out
    assert code == 0, told
    assert "2 of 2 (100.0%)" in told
    crashes = re.search(r"fault: crash +│ (\d+) ", told)
    assert crashes and int(crashes[1]) >= 6
    for what in ("fault: lost", "fault: duplicated", "invariant: one goal at a time", "invariant: a goal id acts once"):
        assert what in told


@pytest.mark.slow
def test_campaign_that_does_not_end_names_each_seed_and_fails(capfd):
    code = app.execute(["simulate", *SMALL, "--seeds", "4-5", "--limit", "3"])
    told = capfd.readouterr().out
    assert code == 1
    assert "seed 4" in told and "seed 5" in told and "NOT ENDED" in told


@pytest.mark.slow
def test_one_seed_is_told_in_full_and_leaves_a_recording_that_opens(tmp_path: Path, capfd):
    file = tmp_path / "seed.mcap"
    assert app.execute(["simulate", *SMALL, "--seed", "7", "--faults", "--trace", str(file)]) == 0
    told = capfd.readouterr().out
    assert "FAULT crash" in told and "seed 7: DONE" in told and "digest" in told
    with Recording(file) as recording:
        keys = {sample.key for sample in recording.samples()}
    assert {"panda/joint_states", "panda/pick_place_status", "panda/camera/image_raw",
            "panda/log/smart_pick_place"} <= keys
    assert app.execute(["info", str(file), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["messages"] > 1000
    assert app.execute(["report", str(file), "-o", str(tmp_path / "seed.html")]) == 0
    assert (tmp_path / "seed.html").stat().st_size > 10_000


@pytest.mark.parametrize(("arguments", "told"), [
    (["--seeds", "9-2"], "--seeds: '9-2' must be a range"),
    (["--seeds", "all"], "--seeds: 'all' must be a range"),
    (["--seed", "-3"], "--seed"),
    (["--seeds", "1-2", "--seed", "1"], "--seed: '1' does not go with --seeds"),
    (["--trace", "a.mcap"], "--trace: 'a.mcap' needs --seed N"),
    (["--seed", "1", "--trace", "a.bag"], "must end in .mcap"),
    (["--jobs", "none"], "--jobs"),
    (["--limit", "0"], "--limit: '0' must be more than 0"),
    (["--set", "robot.hardware.backend=nothing"], "unknown hardware backend 'nothing'"),
])
def test_bad_input_gets_one_line(arguments, told, capfd):
    assert app.execute(["simulate", "panda", *arguments]) == 2
    said = capfd.readouterr().err.strip()
    assert told in said and "\n" not in said


@pytest.mark.slow
def test_ctrl_c_ends_it_with_what_there_is_and_leaves_no_process_behind():
    running = subprocess.Popen(
        [sys.executable, "-m", "cli.main", "simulate", *SMALL, "--seeds", "1-500", "--jobs", "2", "--limit", "5"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )
    try:
        assert running.stderr is not None and "NOT ENDED" in running.stderr.readline()
        running.send_signal(signal.SIGINT)
        table, said = running.communicate(timeout=60.0)
        assert running.returncode == 130, said
        assert "Traceback" not in said and "leaked" not in said
        assert "interrupted after" in said and "DONE" in table
        wait_until(lambda: not group_is_there(running.pid))
    finally:
        running.kill()


def group_is_there(number: int) -> bool:
    try:
        os.killpg(number, 0)
    except ProcessLookupError:
        return False
    return True


def wait_until(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come"
        time.sleep(0.05)


def test_seeds_are_a_range_or_one():
    assert list(seeds_of("3-5")) == [3, 4, 5] and list(seeds_of("8")) == [8]
    with pytest.raises(ConfigError):
        seeds_of("1-")


def test_counts_are_listed_with_the_largest_first():
    assert format_counts({"a": 1, "b": 2000}) == "b 2,000, a 1"
