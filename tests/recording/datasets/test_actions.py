"""Actions of a data set: what was commanded, or the next state; intervals in which an operator had taken over."""

import json
from pathlib import Path

import msgpack
import numpy as np
import pytest

from cli.main import app
from common.messages import Header, SetPoints
from recording.datasets.manifest import Demonstration, Manifest, read_manifest, write_manifest
from recording.reader import Recording
from recording.sample import Sample
from tests.recording.datasets.episodes import FPS, JOINTS_PERIOD, MS, recording, sample
from tests.recording.samples import START, write

pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra datasets")
AHEAD = 0.25  # [rad] of the set-points of joint `a` before its positions
COMMAND = START + 400 * MS  # from which the fingers are commanded to 0.0, and an operator has control


def set_points(number: int) -> Sample:
    stamp = START + number * JOINTS_PERIOD
    seconds = (stamp - START) * 1e-9
    message = SetPoints(header=Header(stamp=stamp), name=["b", "a"], position=[-2 * seconds, seconds + AHEAD],
                        width=None if stamp < COMMAND else 0.0)
    return sample("motion/set_points", message, stamp, number)


def status(number: int, stamp: int, control: str) -> Sample:
    """Return a status whose class is not installed."""
    payload = msgpack.packb({"header": {"stamp": stamp, "frame_id": ""}, "state": "RUN", "control": control})
    return Sample("panda/learned_status", payload, stamp, message="LearnedStatus", kind="state", writer="task.1",
                  sequence=number + 1, schema=b'{"type": "object"}')


def commanded(path: Path, *, taken_over: bool = False) -> Path:
    """Write a recording of 12 frames with set-points, and with the status of a task that an operator takes over."""
    plain = recording(path.with_suffix(".plain"))
    with Recording(plain) as source:
        samples = [*source.samples(), *map(set_points, range(120))]
    plain.unlink()
    if taken_over:
        changes = [(START, "policy"), (COMMAND, "operator"), (COMMAND + 300 * MS, "policy")]
        samples += [status(number, *each) for number, each in enumerate(changes)]
    return write(path, sorted(samples, key=lambda each: each.log_time), every=30)


def export(folder: Path, *arguments: object) -> dict[str, list]:
    assert app.execute(["export", *map(str, arguments), "--lerobot", str(folder), "--embed-images"]) == 0
    return pq.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()


def times(folder: Path, columns: dict[str, list]) -> np.ndarray:
    starts = [each["start_ns"] for each in json.loads((folder / "meta/zencell.json").read_text())["episodes"]]
    return np.array([starts[episode] + frame * (10**9 // FPS) for episode, frame in
                     zip(columns["episode_index"], columns["frame_index"], strict=True)])


def test_action_is_the_set_point_in_force_at_the_next_frame(tmp_path):
    columns = export(tmp_path / "set", commanded(tmp_path / "a.mcap"))
    action, state = np.array(columns["action"]), np.array(columns["observation.state"])
    following = times(tmp_path / "set", columns) + 10**9 // FPS
    newest = np.minimum((following - START) // JOINTS_PERIOD, 119) * JOINTS_PERIOD * 1e-9
    assert np.allclose(action[:, 0], newest + AHEAD, atol=1e-6) and np.allclose(action[:, 1], -2 * newest, atol=1e-6)
    assert np.array_equal(action[:, 2] == 0.0, following >= COMMAND), "the command, not the width that was reached"
    assert np.array_equal(action[:3, 2], state[1:4, 2]), "not commanded yet: the next state"
    assert "intervention" not in columns
    about = json.loads((tmp_path / "set/meta/zencell.json").read_text())
    assert about["actions"] == "set-points" and "set_points" in about["rules"]["action"]


def test_next_state_can_be_the_action(tmp_path):
    columns = export(tmp_path / "set", commanded(tmp_path / "a.mcap"), "--actions", "next-state")
    action, state = np.array(columns["action"]), np.array(columns["observation.state"])
    assert np.array_equal(action[:-1], state[1:]) and np.array_equal(action[-1], state[-1])


@pytest.mark.parametrize("files, options, error", [
    (["plain"], ["--actions", "set-points"], "needs motion/set_points, which"),
    (["commanded", "plain"], [], "needs motion/set_points, which"),
    (["plain"], ["--actions", "goals"], "choices: set-points, next-state"),
])
def test_recording_without_set_points_is_rejected_where_they_are_needed(tmp_path, capsys, files, options, error):
    made = {"plain": recording(tmp_path / "plain.mcap"), "commanded": commanded(tmp_path / "commanded.mcap")}
    paths = [str(made[name]) for name in files]
    assert app.execute(["export", *paths, "--lerobot", str(tmp_path / "set"), *options]) == 2
    assert error in capsys.readouterr().err and not (tmp_path / "set").exists()


def test_frames_in_which_an_operator_had_control_are_marked(tmp_path, capsys):
    columns = export(tmp_path / "set", commanded(tmp_path / "a.mcap", taken_over=True))
    now = times(tmp_path / "set", columns)
    assert np.array_equal(columns["intervention"], (now >= COMMAND) & (now < COMMAND + 300 * MS))
    assert "an operator had control in 3 frames" in capsys.readouterr().out
    features = json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    assert features["intervention"] == {"dtype": "bool", "shape": [1], "names": None}


def test_camera_that_ended_early_is_reported(tmp_path, capsys):
    export(tmp_path / "set", recording(tmp_path / "a.mcap", images=20, dropped=range(8, 20)))
    assert "camera/image_raw: ended 1.2 s before the recording; there are no frames after it" in capsys.readouterr().out


# --- folders of demonstrations ---


@pytest.fixture
def demonstrations(tmp_path):
    folder = tmp_path / "demos"
    folder.mkdir()
    entries = [("a", True, "pick"), ("b", False, "pick"), ("c", True, "place")]
    for name, *_ in entries:
        recording(folder / f"{name}.mcap", images=6)
    write_manifest(folder, Manifest(cell="panda", episodes=[
        Demonstration(file=f"{name}.mcap", success=success, task=task, seed=4) for name, success, task in entries]))
    return folder


@pytest.mark.parametrize("options, episodes, tasks", [
    ((), 2, ["pick", "place"]), (("--failures",), 3, ["pick", "pick", "place"]), (("--task", "sort"), 2, ["sort"] * 2)])
def test_folder_of_demonstrations_is_exported_as_a_whole(demonstrations, tmp_path, capsys, options, episodes, tasks):
    columns = export(tmp_path / "set", demonstrations, *options)
    assert set(columns["episode_index"]) == set(range(episodes))
    found = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert found["tasks"] == [[task] for task in tasks]
    assert ("1 failed episodes left out" in capsys.readouterr().out) == ("--failures" not in options)


@pytest.mark.parametrize("manifest, error", [
    (None, "is a folder without episodes.json"), ("{", "cannot be read"),
    (100_000 * "[", "cannot be read: maximum recursion"),
    ('{"cell": "a", "episodes": [{"file": "\\u0000.mcap", "success": true, "task": ""}]}', "episodes.0.file"),
    ('{"cell": "panda", "episodes": []}', "has no episode that succeeded"),
    ('{"cell": "panda", "episodes": [{"file": "../a.mcap", "success": true, "task": ""}]}', "episodes.0.file"),
    ('{"cell": "panda", "episodes": [{"file": "a.mcap", "task": ""}]}', "episodes.0.success: is missing"),
])
def test_invalid_folder_is_rejected_in_one_line(tmp_path, capsys, manifest, error):
    folder = tmp_path / "demos"
    folder.mkdir()
    if manifest is not None:
        (folder / "episodes.json").write_text(manifest)
    assert app.execute(["export", str(folder), "--lerobot", str(tmp_path / "set")]) == 2
    said = capsys.readouterr().err
    assert error in said and said.count("\n") == 1


def test_manifest_is_read_as_it_was_written(demonstrations):
    assert [each.seed for each in read_manifest(demonstrations).episodes] == [4, 4, 4]
