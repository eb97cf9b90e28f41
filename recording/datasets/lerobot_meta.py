"""The folder meta/ of a LeRobotDataset v3.0: features, tasks, episodes and statistics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from recording.datasets import optional
from recording.datasets.episode import Camera
from recording.datasets.statistics import PixelStatistics, Statistics, of_numbers
from recording.datasets.video import PIXELS
from recording.sample import RecordingError

OPTION = "--lerobot"
VERSION = "v3.0"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"  # a large data set has thousands of episodes: one file
INDEX = "__index_level_0__"  # of pandas, for an index without a name
ONE_NUMBER = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64",
              "task_index": "int64"}


def feature_of_camera(camera: Camera, fps: int, *, embed: bool) -> dict[str, Any]:
    """Return the description of the images of a camera."""
    feature: dict[str, Any] = {"dtype": "image" if embed else "video", "shape": [camera.height, camera.width, 3],
                               "names": ["height", "width", "channels"]}
    if not embed:
        feature["info"] = {
            "video.height": camera.height, "video.width": camera.width, "video.codec": "h264", "video.pix_fmt": PIXELS,
            "video.is_depth_map": False, "video.fps": fps, "video.channels": 3, "has_audio": False,
        }
    return feature


class Meta:
    """Collects the description of episodes, and writes it at the end."""

    def __init__(self, folder: Path, fps: int, robot_type: str, *, embed: bool) -> None:
        """Describe a data set without episodes."""
        self._folder, self._fps, self._robot_type, self._embed = folder, fps, robot_type, embed
        self.frames = 0
        self.episodes: list[dict[str, Any]] = []
        self._features: dict[str, Any] = {}
        self._tasks: dict[str, int] = {}
        self._numbers: dict[str, list[npt.NDArray[Any]]] = {}  # of all episodes: tens of bytes a frame
        self._pixels: dict[str, PixelStatistics] = {}

    def task_index(self, task: str) -> int:
        """Return the index of a task, a new one if it is not known yet."""
        return self._tasks.setdefault(task, len(self._tasks))

    def require_same(self, features: dict[str, Any], path: Path) -> None:
        """Return if features are those of the first episode.

        Raises:
            RecordingError: names the recording and the feature that differs.
        """
        self._features = self._features or features
        for key in {**self._features, **features}:
            if features.get(key) != self._features.get(key):
                here, first = _shown(features.get(key)), _shown(self._features.get(key))
                raise RecordingError(f"{path}: {key} is {here}, but {first} in the first recording")

    def add(
        self, task: str, length: int, place: dict[str, Any], statistics: dict[str, Statistics],
        columns: dict[str, npt.NDArray[Any]], pixels: dict[str, PixelStatistics],
    ) -> None:
        """Add an episode: its files and statistics, and the values for the statistics of all episodes."""
        self.episodes.append({
            "episode_index": len(self.episodes), "tasks": [task], "length": length, **place,
            "dataset_from_index": self.frames, "dataset_to_index": self.frames + length,
            "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
            **{f"stats/{key}/{name}": value for key, each in statistics.items() for name, value in each.items()},
        })
        self.frames += length
        for key, values in columns.items():
            self._numbers.setdefault(key, []).append(values)
        for key, counted in pixels.items():
            self._pixels.setdefault(key, PixelStatistics()).merge(counted)

    def write(self, provenance: dict[str, Any]) -> None:
        """Write all files of meta/."""
        pa, pq = optional("pyarrow", OPTION), optional("pyarrow.parquet", OPTION)
        statistics = {key: of_numbers(np.concatenate(parts)) for key, parts in self._numbers.items()}
        statistics |= {key: each.statistics() for key, each in self._pixels.items()}
        (self._folder / "meta").mkdir(parents=True, exist_ok=True)
        self._write_json("info.json", self._info())
        self._write_json("stats.json", statistics)
        self._write_json("zencell.json", provenance)
        pq.write_table(self._task_table(pa), self._folder / "meta" / "tasks.parquet")
        path = self._folder / EPISODES_PATH
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(self.episodes), path)

    def _write_json(self, name: str, value: dict[str, Any]) -> None:
        (self._folder / "meta" / name).write_text(json.dumps(value, indent=4, ensure_ascii=False), encoding="utf-8")

    def _info(self) -> dict[str, Any]:
        videos = any(feature["dtype"] == "video" for feature in self._features.values())
        features = self._features | {
            name: {"dtype": kind, "shape": [1], "names": None} for name, kind in ONE_NUMBER.items()}
        return {
            "codebase_version": VERSION, "robot_type": self._robot_type, "total_episodes": len(self.episodes),
            "total_frames": self.frames, "total_tasks": len(self._tasks), "chunks_size": 1000,
            "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": self._fps,
            "splits": {"train": f"0:{len(self.episodes)}"}, "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if videos else None, "features": features,
        }

    def _task_table(self, pa: Any) -> Any:
        """Return the tasks as pandas writes them: the text is the index."""
        about = {
            "index_columns": [INDEX], "column_indexes": [], "columns": [
                {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64",
                 "metadata": None},
                {"name": None, "field_name": INDEX, "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
            ], "creator": {"library": "pyarrow", "version": pa.__version__}, "pandas_version": "2.0.0",
        }
        table = pa.table({"task_index": pa.array(list(self._tasks.values()), pa.int64()),
                          INDEX: pa.array(list(self._tasks), pa.string())})
        return table.replace_schema_metadata({"pandas": json.dumps(about)})


def _shown(feature: dict[str, Any] | None) -> str:
    if feature is None:
        return "missing"
    if len(feature["shape"]) == 3:
        return f"{feature['shape'][1]}x{feature['shape'][0]}"
    return ", ".join(feature["names"] or ["there"])
