"""LeRobotDataset v3.0: layout, columns, statistics and video; and lerobot's own loader, where it is installed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from cli.main import app
from recording.datasets import lerobot
from tests.recording.datasets import episodes
from tests.recording.datasets.episodes import HEIGHT, WIDTH, picture, position, recording
from tests.recording.samples import START

pa = pytest.importorskip("pyarrow", reason="needs the extra datasets")
av = pytest.importorskip("av", reason="needs the extra datasets")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra datasets")
LEROBOT = os.environ.get("ZENCELL_LEROBOT_PYTHON", "")
CAMERA = "observation.images.camera"
READER = Path(__file__).with_name("lerobot_reader.py")
STEPS = [("min", 0), ("max", 1), ("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    return [recording(folder / "first.mcap", dropped=(4,)), recording(folder / "second.mcap", images=8)]


@pytest.fixture(scope="module", params=[False, True], ids=["video", "embedded"])
def written(request, recordings, tmp_path_factory):
    """Return the folder of a data set with two episodes of 12 and 8 frames, and whether its images are embedded."""
    folder = tmp_path_factory.mktemp("written") / "set"
    options = ["--lerobot", str(folder), "--task", "pick", "--task", "place", "--robot-type", "panda"]
    assert app.execute(["export", *map(str, recordings), *options, *["--embed-images"][: request.param]]) == 0
    return folder, request.param


def rows(folder: Path) -> dict:
    return pq.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()


def test_layout_and_features_are_those_of_version_3(written):
    folder, embedded = written
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert names == {
        "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet",
        "meta/zencell.json", "data/chunk-000/file-000.parquet",
        *([] if embedded else [f"videos/{CAMERA}/chunk-000/file-000.mp4"])}
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 10, "panda")
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 20, 2)
    assert info["splits"] == {"train": "0:2"}
    features = info["features"]
    assert features["action"] == {"dtype": "float32", "shape": [3], "names": ["a", "b", "gripper.width"]}
    assert features["observation.state"] == features["action"]
    assert features[CAMERA]["shape"] == [HEIGHT, WIDTH, 3]
    assert features[CAMERA]["dtype"] == ("image" if embedded else "video")


def test_columns_have_the_types_of_lerobot(written):
    folder, embedded = written
    schema = pq.read_schema(folder / "data/chunk-000/file-000.parquet")
    kinds = {name: str(schema.field(name).type) for name in schema.names}
    image = {CAMERA: "struct<bytes: binary, path: string>"} if embedded else {}
    vector = "fixed_size_list<element: float>[3]"
    assert kinds == {"action": vector, "observation.state": vector, "timestamp": "float", "frame_index": "int64",
                     "episode_index": "int64", "index": "int64", "task_index": "int64", **image}


def test_episodes_follow_each_other_and_tasks_are_their_own(written):
    folder, _ = written
    columns = rows(folder)
    assert columns["episode_index"] == [0] * 12 + [1] * 8
    assert columns["frame_index"] == [*range(12), *range(8)] and columns["index"] == list(range(20))
    assert columns["task_index"] == columns["episode_index"]
    assert np.allclose(columns["timestamp"], np.array(columns["frame_index"]) / 10)
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0, 1], "__index_level_0__": ["pick", "place"]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]
    found = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert (found["dataset_from_index"], found["dataset_to_index"]) == ([0, 12], [12, 20])
    assert (found["length"], found["tasks"]) == ([12, 8], [["pick"], ["place"]])


def test_state_is_recorded_within_the_printed_error_and_action_is_the_next_state(written):
    folder, _ = written
    columns, about = rows(folder), json.loads((folder / "meta/zencell.json").read_text())["episodes"]
    for number, episode in enumerate(about):
        mine = np.array(columns["episode_index"]) == number
        state, action = np.array(columns["observation.state"])[mine], np.array(columns["action"])[mine]
        times = episode["start_ns"] + np.array(columns["frame_index"])[mine] * 100_000_000
        error = episode["streams"]["joint_states"]["max_error_ms"] * 1e-3
        expected = np.array([position(int(t)) for t in times])[:, [0, 2]]  # the first moves at 1/s, the second at 2/s
        assert 0 < error <= 0.005 and np.abs(state[:, :2] - expected).max() <= 2 * error + 1e-6
        assert np.array_equal(action[:-1], state[1:]) and np.array_equal(action[-1], state[-1])
        assert np.array_equal(state[:, 2] < 0.05, times >= START + 500_000_000)
    assert [each["streams"]["camera/image_raw"]["filled_frames"] for each in about] == [[4], []]


def shown(folder: Path, embedded: bool) -> list[np.ndarray]:
    """Return the images of a data set as RGB."""
    if embedded:
        data = [each["bytes"] for each in rows(folder)[CAMERA]]
        return [cv2.imdecode(np.frombuffer(each, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] for each in data]
    with av.open(str(folder / f"videos/{CAMERA}/chunk-000/file-000.mp4")) as video:
        frames = list(video.decode(video=0))
    assert [round(frame.time * 10, 3) for frame in frames] == list(range(20))
    return [frame.to_ndarray(format="rgb24") for frame in frames]


def test_images_are_those_of_the_frames(written):
    folder, embedded = written
    found = shown(folder, embedded)
    assert len(found) == 20
    for pixels, number in zip(found, [0, 1, 2, 3, 3, *range(5, 12), *range(8)], strict=True):
        expected = picture(number)
        if embedded:
            assert np.array_equal(pixels, expected)
        else:  # YUV 4:2:0 with loss
            assert np.abs(pixels[:, [4, -4]].astype(int) - expected[:, [4, -4]]).max() <= 8


def recomputed(values: np.ndarray, axes: tuple[int, ...], method: str) -> dict[str, np.ndarray]:
    found = {name: np.quantile(values, part, axis=axes, method=method) for name, part in STEPS}
    return found | {"mean": values.mean(axis=axes), "std": values.std(axis=axes)}


def test_statistics_are_those_of_the_written_columns(written):
    folder, embedded = written
    columns, statistics = rows(folder), json.loads((folder / "meta/stats.json").read_text())
    assert set(statistics) == {*columns, CAMERA}
    for name in set(columns) - {CAMERA}:
        values = np.array(columns[name], np.float64).reshape(20, -1)
        for key, expected in recomputed(values, (0,), "linear").items():
            assert np.allclose(statistics[name][key], expected, atol=1e-9), (name, key)
        assert statistics[name]["count"] == [20]
    if embedded:  # with video the statistics are of the images before the loss
        images = np.array(shown(folder, embedded)) / 255
        for key, expected in recomputed(images, (0, 1, 2), "inverted_cdf").items():
            assert np.allclose(np.squeeze(statistics[CAMERA][key]), expected), key
    assert np.shape(statistics[CAMERA]["mean"]) == (3, 1, 1)
    episode = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    second = np.array(columns["observation.state"], np.float64)[12:]
    assert np.allclose(episode["stats/observation.state/mean"][1], second.mean(axis=0))
    assert np.allclose(episode["stats/observation.state/std"][1], second.std(axis=0))


@pytest.mark.skipif(not LEROBOT, reason="ZENCELL_LEROBOT_PYTHON does not name a Python that has lerobot 0.4")
def test_loader_of_lerobot_returns_the_written_columns(written, tmp_path):
    folder, embedded = written
    done = subprocess.run([LEROBOT, str(READER), str(folder), str(tmp_path / "read.npz")], text=True, check=False,
                          capture_output=True, env=os.environ | {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path)})
    assert done.returncode == 0, done.stderr
    read, columns = np.load(tmp_path / "read.npz"), rows(folder)
    assert (read["fps"], read["episodes"]) == (10, 2)
    assert read["task"].tolist() == ["pick"] * 12 + ["place"] * 8
    for name in set(columns) - {CAMERA}:
        assert np.array_equal(read[name], np.array(columns[name], read[name].dtype)), name
    images = np.round(read[CAMERA].transpose(0, 2, 3, 1) * 255).astype(int)
    assert np.abs(images - np.array(shown(folder, embedded), int)).max() <= (0 if embedded else 1)
    assert np.array_equal(read["windows"][:, 0], read["action"])
    assert np.array_equal(read["windows"][:11, 1], read["action"][1:12])
    assert np.allclose(read["means"], read["observation.state"].mean(axis=0))


ERRORS = [
    ({}, [], "exists already; choose another name", True),
    ({}, ["--fps", "0"], "--fps: '0' must be a number above 0", False),
    ({}, ["--fps", "ten"], "--fps: 'ten' must be a number above 0", False),
    ({}, ["--fps", "7.5"], "--fps: '7.5' must be a whole number from 1 to 1000", False),
    ({"cameras": ()}, [], "--fps: is needed:", False),
    ({}, ["--topics", "wrist/image_raw"], "--topics: 'wrist/image_raw' is not in", False),
    ({"with_joints": False}, [], "has no joint_states, which a data set needs", False),
    ({"dropped": range(2, 9)}, [], "more than --max-gap 0.5", False),
    ({}, ["--max-gap", "x"], "--max-gap: 'x' must be a number above 0", False),
    ({}, ["--task", "a", "--task", "b"], "must be one for all, or one for each of the 1 recordings", False),
]


@pytest.mark.parametrize(("given", "options", "expected", "exists"), ERRORS, ids=[each[2] for each in ERRORS])
def test_what_does_not_fit_is_one_line_and_leaves_no_folder(tmp_path, capsys, given, options, expected, exists):
    path, folder = recording(tmp_path / "a.mcap", **given), tmp_path / "set"
    if exists:
        folder.mkdir()
    assert app.execute(["export", str(path), "--lerobot", str(folder), *options]) == 2
    shown = capsys.readouterr().err
    assert expected in shown and shown.count("\n") == 1
    assert {each.name for each in tmp_path.iterdir()} == {"a.mcap", *(["set"] if exists else [])}


def test_recording_with_another_camera_is_rejected(tmp_path, capsys):
    first = recording(tmp_path / "a.mcap", cameras=("camera/image_raw", "wrist/image_raw"))
    second = recording(tmp_path / "b.mcap")
    assert app.execute(["export", str(first), str(second), "--lerobot", str(tmp_path / "set")]) == 2
    assert "b.mcap: observation.images.wrist is missing, but 24x16 in the first" in capsys.readouterr().err


def test_depth_is_left_out_with_a_line(tmp_path, capsys):
    path = recording(tmp_path / "a.mcap", images=4, with_depth=True)
    assert app.execute(["export", str(path), "--lerobot", str(tmp_path / "set")]) == 0
    assert "depth_camera/depth/image_raw: depth left out" in capsys.readouterr().out
    assert [each.name for each in (tmp_path / "set" / "videos").iterdir()] == [CAMERA]


def test_odd_sizes_are_rejected_for_video(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(episodes, "WIDTH", 25)
    path = recording(tmp_path / "a.mcap", images=4)
    assert app.execute(["export", str(path), "--lerobot", str(tmp_path / "set")]) == 2
    assert "25x16, but video needs even sizes: use --embed-images" in capsys.readouterr().err
    assert app.execute(["export", str(path), "--lerobot", str(tmp_path / "set"), "--embed-images"]) == 0


def test_large_files_are_followed_by_the_next_at_the_next_episode(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot, "DATA_BYTES", 1)
    monkeypatch.setattr(lerobot, "VIDEO_BYTES", 1)
    monkeypatch.setattr(lerobot, "FILES_PER_CHUNK", 1)
    folder = tmp_path / "set"
    assert app.execute(["export", *map(str, recordings), "--lerobot", str(folder)]) == 0
    episode = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    for kind in ("data", f"videos/{CAMERA}"):
        assert (episode[f"{kind}/chunk_index"], episode[f"{kind}/file_index"]) == ([0, 1], [0, 0])
    assert episode[f"videos/{CAMERA}/from_timestamp"] == [0, 0]
    assert episode[f"videos/{CAMERA}/to_timestamp"] == [1.2, 0.8]
    second = pq.read_table(folder / "data/chunk-001/file-000.parquet").to_pydict()
    assert second["index"] == list(range(12, 20))
    with av.open(str(folder / f"videos/{CAMERA}/chunk-001/file-000.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 8


def test_missing_package_names_the_extra(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    path = recording(tmp_path / "a.mcap")
    assert app.execute(["export", str(path), "--lerobot", str(tmp_path / "set")]) == 2
    assert "--lerobot: needs the extra `datasets`: pip install 'zencell[datasets]'" in capsys.readouterr().err
