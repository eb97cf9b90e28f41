"""LeRobotDataset v3.0: episodes follow each other in Parquet and video files; `lerobot_meta` describes them.

Layout and defaults are those of lerobot 0.4.4 (`lerobot/datasets/lerobot_dataset.py`, `utils.py`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from recording.datasets import optional
from recording.datasets.episode import Camera, Episode
from recording.datasets.lerobot_meta import Meta, feature_of_camera
from recording.datasets.statistics import PixelStatistics, Statistics, of_numbers
from recording.datasets.video import VideoFile
from recording.reader import Recording

OPTION = "--lerobot"
FILE = "chunk-{chunk:03d}/file-{file:03d}"
FILES_PER_CHUNK = 1000
DATA_BYTES, VIDEO_BYTES = 100 * 1024**2, 200 * 1024**2  # of a file, after which the next episode starts a new one
ROWS = 1000  # of a row group; with embedded images fewer
ROWS_WITH_IMAGES = 50
STATE, ACTION, IMAGES = "observation.state", "action", "observation.images."
INTERVENTION = "intervention"  # whether an operator had control


@dataclass
class _Place:
    """Number of a file."""

    chunk: int = 0
    file: int = 0

    def path(self, root: Path, suffix: str) -> Path:
        return root / f"{FILE.format(chunk=self.chunk, file=self.file)}{suffix}"

    def advance(self) -> None:
        self.file += 1
        if self.file == FILES_PER_CHUNK:
            self.chunk, self.file = self.chunk + 1, 0


class LeRobotWriter:
    """Writes episodes of the same robot and cameras to a new folder."""

    def __init__(self, folder: Path, fps: int, robot_type: str, *, embed: bool = False) -> None:
        """Prepare a data set; `embed` puts images into the Parquet files as PNG, instead of video.

        Raises:
            ConfigError: pyarrow is not installed.
        """
        self._pa, self._pq = optional("pyarrow", OPTION), optional("pyarrow.parquet", OPTION)
        self._folder, self._fps, self._embed = folder, fps, embed
        self._meta = Meta(folder, fps, robot_type, embed=embed)
        self._data: Any = None
        self._data_place = _Place()
        self._videos: dict[str, VideoFile] = {}
        self._video_places: dict[str, _Place] = {}

    def add(self, recording: Recording, episode: Episode, task: str) -> None:
        """Append an episode.

        Raises:
            ConfigError: it differs from the first in joints or cameras, or an image cannot be a video.
            RecordingError: the recording is damaged.
        """
        cameras = episode.cameras  # without depth
        self._require_video(cameras)
        features = {STATE: _vector(episode.names), ACTION: _vector(episode.names)} | {
            f"{IMAGES}{camera.name}": feature_of_camera(camera, self._fps, embed=self._embed) for camera in cameras}
        if episode.intervention is not None:
            features[INTERVENTION] = {"dtype": "bool", "shape": [1], "names": None}
        self._meta.require_same(features, episode.path)
        first = self._meta.frames
        columns = _columns(episode, len(self._meta.episodes), first, self._meta.task_index(task))
        statistics: dict[str, Statistics] = {key: of_numbers(values) for key, values in columns.items()}
        pixels = {f"{IMAGES}{camera.name}": PixelStatistics() for camera in cameras}
        streams = {f"{IMAGES}{camera.name}": episode.pixels(recording, camera) for camera in cameras}
        place: dict[str, Any] = {}
        if self._embed:
            self._write_rows(columns, {key: _encoded(each, pixels[key]) for key, each in streams.items()})
        else:
            self._write_rows(columns, {})
            for (key, images), camera in zip(streams.items(), cameras, strict=True):
                place |= self._write_video(key, images, camera, pixels[key])
        place |= {"data/chunk_index": self._data_place.chunk, "data/file_index": self._data_place.file}
        statistics |= {key: each.statistics() for key, each in pixels.items()}
        self._meta.add(task, len(episode), place, statistics, columns, pixels)

    def close(self, provenance: dict[str, Any]) -> None:
        """Write the rest of the files; `provenance` becomes meta/zencell.json."""
        for video in self._videos.values():
            video.close()
        if self._data is not None:
            self._data.close()
        self._meta.write(provenance)

    def abandon(self) -> None:
        """Release files that were not finished; their destructors do."""
        self._data, self._videos = None, {}

    def _require_video(self, cameras: tuple[Camera, ...]) -> None:
        for camera in cameras:
            if not self._embed and (camera.width % 2 or camera.height % 2):
                raise ConfigError("--topics", camera.topic, f"has images of {camera.width}x{camera.height}, but video "
                                                            "needs even sizes: use --embed-images")

    def _write_rows(
        self, columns: dict[str, npt.NDArray[Any]], images: dict[str, Iterator[dict[str, Any]]],
    ) -> None:
        """Append rows to the current Parquet file, or to the next if that is large."""
        schema = self._schema(columns, images)
        path = self._data_place.path(self._folder / "data", ".parquet")
        if self._data is not None and path.stat().st_size >= DATA_BYTES:
            self._data.close()
            self._data = None
            self._data_place.advance()
            path = self._data_place.path(self._folder / "data", ".parquet")
        if self._data is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._data = self._pq.ParquetWriter(path, schema, compression="snappy")
        count, step = len(columns["index"]), ROWS_WITH_IMAGES if images else ROWS
        for start in range(0, count, step):
            end = min(start + step, count)
            arrays = [self._array(columns[name][start:end], field.type) if name in columns
                      else self._pa.array([next(images[name]) for _ in range(end - start)], field.type)
                      for name, field in zip(schema.names, schema, strict=True)]
            self._data.write_table(self._pa.Table.from_arrays(arrays, schema=schema))

    def _schema(self, columns: dict[str, npt.NDArray[Any]], images: dict[str, Any]) -> Any:
        pa = self._pa
        picture = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        fields = [
            (name, pa.list_(pa.float32(), values.shape[1]) if values.ndim == 2 else pa.from_numpy_dtype(values.dtype))
            for name, values in columns.items()]
        return pa.schema([*fields, *((name, picture) for name in images)])

    def _array(self, values: npt.NDArray[Any], kind: Any) -> Any:
        if values.ndim == 1:
            return self._pa.array(values, kind)
        return self._pa.FixedSizeListArray.from_arrays(self._pa.array(values.reshape(-1), kind.value_type), type=kind)

    def _write_video(
        self, key: str, images: Iterator[npt.NDArray[Any]], camera: Camera, statistics: PixelStatistics,
    ) -> dict[str, Any]:
        """Append images to the current video of a camera, or to the next; return where they are."""
        place, video = self._video_places.setdefault(key, _Place()), self._videos.get(key)
        if video is not None and video.path.stat().st_size >= VIDEO_BYTES:
            video.close()
            video = None
            place.advance()
        if video is None:
            path = place.path(self._folder / "videos" / key, ".mp4")
            video = self._videos[key] = VideoFile(path, self._fps, camera.width, camera.height, OPTION)
        start = video.frames
        for pixels in images:
            video.add(pixels)
            statistics.add(pixels)
        return {
            f"videos/{key}/chunk_index": place.chunk, f"videos/{key}/file_index": place.file,
            f"videos/{key}/from_timestamp": start / self._fps, f"videos/{key}/to_timestamp": video.frames / self._fps,
        }


def _vector(names: tuple[str, ...]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


def _columns(episode: Episode, number: int, first: int, task: int) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of an episode without images, in the order of the file."""
    count = len(episode)
    frames = np.arange(count, dtype=np.int64)
    taken_over = {} if episode.intervention is None else {INTERVENTION: episode.intervention}
    return {
        ACTION: episode.action.astype(np.float32), STATE: episode.state.astype(np.float32), **taken_over,
        "timestamp": (frames / episode.fps).astype(np.float32), "frame_index": frames,
        "episode_index": np.full(count, number, np.int64), "index": frames + first,
        "task_index": np.full(count, task, np.int64),
    }


def _encoded(images: Iterator[npt.NDArray[Any]], statistics: PixelStatistics) -> Iterator[dict[str, Any]]:
    for number, pixels in enumerate(images):
        statistics.add(pixels)
        _, data = cv2.imencode(".png", pixels[..., ::-1])
        yield {"bytes": data.tobytes(), "path": f"frame-{number:06d}.png"}
