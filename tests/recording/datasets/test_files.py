"""robomimic's HDF5, and tables of topics as Parquet and numpy files."""

import io
import json
import os
import resource
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture

from cli.main import app
from recording.access import open_recording
from tests.recording.datasets.episodes import HEIGHT, WIDTH, exposure, picture, recording

ROBOMIMIC = os.environ.get("ZENCELL_ROBOMIMIC_PYTHON", "")
READER = Path(__file__).with_name("robomimic_reader.py")


def test_robomimic_file_has_demos_observations_and_filter_keys(tmp_path):
    h5py = pytest.importorskip("h5py", reason="needs the extra datasets")
    paths = [recording(tmp_path / f"{n}.mcap", images=6 + n, with_depth=True) for n in range(3)]
    file = tmp_path / "set.hdf5"
    assert app.execute(["export", *map(str, paths), "--hdf5", str(file), "--task", "pick", "--fps", "10"]) == 0
    with h5py.File(file) as found:
        data = found["data"]
        assert data.attrs["total"] == 6 + 7 + 8 and json.loads(data.attrs["env_args"])["env_name"] == "panda"
        assert [data[f"demo_{n}"].attrs["num_samples"] for n in range(3)] == [6, 7, 8]
        assert found["mask/train"][:].tolist() == [b"demo_0", b"demo_1"]
        assert found["mask/valid"][:].tolist() == [b"demo_2"]
        demo = data["demo_1"]
        shapes = {name: demo["obs"][name].shape for name in demo["obs"]}
        assert shapes == {"joint_pos": (7, 2), "gripper_width": (7, 1), "camera_image": (7, HEIGHT, WIDTH, 3),
                          "depth_camera_depth": (7, HEIGHT, WIDTH, 1)}
        state = np.column_stack([demo["obs/joint_pos"], demo["obs/gripper_width"]])
        assert np.array_equal(demo["actions"][:-1], state[1:]) and demo["dones"][:].tolist() == [0] * 6 + [1]
        assert all(np.array_equal(demo["obs/camera_image"][k], picture(k)) for k in range(7))
        depth = demo["obs/depth_camera_depth"][3, ..., 0]
        assert np.isnan(depth[0, 0]) and depth[5, 5] == np.float32(1.3)


@pytest.mark.skipif(not ROBOMIMIC, reason="ZENCELL_ROBOMIMIC_PYTHON does not name a Python that has robomimic 0.3")
def test_loader_of_robomimic_returns_the_recorded_values(tmp_path):
    h5py = pytest.importorskip("h5py", reason="needs the extra datasets")
    paths = [recording(tmp_path / f"{n}.mcap", images=6 + n) for n in range(3)]
    assert app.execute(["export", *map(str, paths), "--hdf5", str(tmp_path / "set.hdf5")]) == 0
    done = subprocess.run([ROBOMIMIC, str(READER), str(tmp_path / "set.hdf5"), str(tmp_path / "read.npz")], text=True,
                          check=False, capture_output=True)
    assert done.returncode == 0, done.stderr
    read = np.load(tmp_path / "read.npz")
    with h5py.File(tmp_path / "set.hdf5") as found:
        for part, names in (("train", ["demo_0", "demo_1"]), ("valid", ["demo_2"])):
            demos = [found["data"][name] for name in names]
            for key in ("joint_pos", "gripper_width", "camera_image"):
                expected = np.concatenate([demo["obs"][key] for demo in demos])
                assert np.array_equal(read[f"{part}_{key}"], expected), key
            assert np.allclose(read[f"{part}_actions"], np.concatenate([demo["actions"] for demo in demos]), atol=1e-6)


def test_parquet_and_numpy_files_have_every_message_of_a_topic(tmp_path):
    pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra datasets")
    path = recording(tmp_path / "a.mcap")
    assert app.execute(["export", str(path), "--parquet", str(tmp_path / "pq"), "--numpy", str(tmp_path / "np")]) == 0
    with open_recording(path) as opened:
        table = opened.table("joint_states")
    columns = pq.read_table(tmp_path / "pq" / "joint_states.parquet").to_pydict()
    arrays = np.load(tmp_path / "np" / "joint_states.npz")
    assert set(columns) == set(arrays) == {"stamp_ns", "log_time_ns", *table.names}
    for name in table.names:
        assert np.array_equal(columns[name], table[name]) and np.array_equal(arrays[name], table[name])
    assert columns["stamp_ns"] == table.stamp_ns.tolist() == arrays["stamp_ns"].tolist()
    images = pq.read_table(tmp_path / "pq" / "camera_image_raw.parquet").to_pydict()
    pixels = np.load(tmp_path / "np" / "camera_image_raw.npy", mmap_mode="r")
    assert pixels.shape == (12, HEIGHT, WIDTH, 3)
    for k in range(12):
        assert np.array_equal(np.array(Picture.open(io.BytesIO(images["image"][k]))), picture(k))
        assert np.array_equal(pixels[k][..., ::-1], picture(k)) and images["stamp_ns"][k] == exposure(k)
    description = pq.read_table(tmp_path / "pq" / "robot_description.parquet").to_pydict()
    assert description["lower"] == [[-9, -9]] and description["joints"] == ['["a", "b"]']


def test_several_recordings_have_a_folder_each(tmp_path):
    paths = [recording(tmp_path / f"{name}.mcap", images=3) for name in ("a", "b")]
    assert app.execute(["export", *map(str, paths), "--numpy", str(tmp_path / "np"), "--topics", "joint_states"]) == 0
    found = sorted(path.relative_to(tmp_path / "np").as_posix() for path in (tmp_path / "np").rglob("*.npz"))
    assert found == ["a/joint_states.npz", "b/joint_states.npz"]


@pytest.mark.parametrize("option", [
    ["--lerobot", "set"], ["--lerobot", "set", "--embed-images"], ["--hdf5", "set.hdf5"]])
def test_data_set_that_does_not_fit_on_the_disk_leaves_nothing(tmp_path, capsys, option):
    pytest.importorskip("h5py", reason="needs the extra datasets")
    path, before = recording(tmp_path / "a.mcap"), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))  # [bytes] of each file
    try:
        code = app.execute(["export", str(path), option[0], str(tmp_path / option[1]), *option[2:]])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert code == 1 and "cannot be written, the disk is full" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]


def test_recordings_of_the_same_name_do_not_overwrite_each_other(tmp_path, capsys):
    (tmp_path / "other").mkdir()
    paths = [recording(folder / "a.mcap", images=3) for folder in (tmp_path, tmp_path / "other")]
    assert app.execute(["export", *map(str, paths), "--numpy", str(tmp_path / "np")]) == 2
    assert "two recordings have the same name" in capsys.readouterr().err


def test_format_of_one_file_rejects_several_recordings(tmp_path, capsys):
    paths = [recording(tmp_path / f"{name}.mcap", images=3) for name in ("a", "b")]
    assert app.execute(["export", *map(str, paths), "--csv", str(tmp_path / "csv")]) == 2
    assert "takes one recording, not 2" in capsys.readouterr().err
