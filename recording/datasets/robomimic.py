"""One HDF5 file in the layout of robomimic: `data/demo_0/obs/...`, `actions`, filter keys `mask/train`, `mask/valid`.

See https://robomimic.github.io/docs/datasets/overview.html. Rewards are 0, since a recording has none; `dones` is 1 at
the last frame. `env_args` names the cell: there is no simulated environment for rollouts.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from recording.datasets import optional
from recording.datasets.deferring_file import DeferringFile
from recording.datasets.episode import WIDTH, Camera, Episode
from recording.reader import Recording
from recording.sample import RecordingError

OPTION = "--hdf5"
VALID_EVERY = 10  # the last of each ten demonstrations is for validation
GYM = 2  # robomimic.envs.env_base.EnvType


class RobomimicWriter:
    """Writes demonstrations of the same robot and cameras to a new file."""

    def __init__(self, path: Path, fps: int) -> None:
        """Create the file.

        Raises:
            ConfigError: h5py is not installed.
        """
        self._h5py = optional("h5py", OPTION)
        self._sink = DeferringFile(path)
        self._file: Any = self._h5py.File(self._sink, "w")
        self._data: Any = self._file.create_group("data")
        self._fps, self._frames, self._demos = fps, 0, list[str]()
        self._layout: dict[str, Any] = {}

    def add(self, recording: Recording, episode: Episode, task: str) -> None:
        """Append a demonstration.

        Raises:
            RecordingError: it differs from the first in joints or cameras, or the recording is damaged.
        """
        sizes = {_key(camera): (camera.height, camera.width) for camera in episode.cameras}
        layout = {"joints": episode.names, **sizes}
        self._layout = self._layout or layout
        if layout != self._layout:
            here, first = _shown(layout), _shown(self._layout)
            raise RecordingError(f"{episode.path}: has {here}, but the first recording {first}")
        name = f"demo_{len(self._demos)}"
        demo = self._data.create_group(name)
        count = len(episode)
        dones = np.zeros(count)
        dones[-1] = 1
        for key, values in (("actions", episode.action), ("rewards", np.zeros(count)), ("dones", dones)):
            demo.create_dataset(key, data=values)
        if episode.intervention is not None:
            demo.create_dataset("interventions", data=episode.intervention.astype(np.int64))
        obs = demo.create_group("obs")
        arm = [i for i, joint in enumerate(episode.names) if joint != WIDTH]
        obs.create_dataset("joint_pos", data=episode.state[:, arm])
        if WIDTH in episode.names:
            obs.create_dataset("gripper_width", data=episode.state[:, [episode.names.index(WIDTH)]])
        for camera in episode.cameras:
            shape = (camera.height, camera.width, 1 if camera.depth else 3)
            images = obs.create_dataset(_key(camera), (count, *shape), np.float32 if camera.depth else np.uint8,
                                        chunks=(1, *shape), compression="gzip", compression_opts=1)
            for i, pixels in enumerate(episode.pixels(recording, camera)):
                images[i] = pixels.reshape(shape)
                self._sink.check()
        demo.attrs.update(num_samples=count, task=task, recording=episode.path.name, start_ns=int(episode.times[0]))
        self._demos.append(name)
        self._frames += count
        self._data.attrs["env_args"] = self._data.attrs.get("env_args") or json.dumps({
            "env_name": episode.cell, "type": GYM, "env_kwargs": {"fps": self._fps, "state_names": episode.names}})

    def close(self, provenance: dict[str, Any]) -> None:
        """Write the filter keys and `provenance`, and close the file."""
        self._data.attrs["total"] = self._frames
        self._data.attrs["zencell"] = json.dumps(provenance)
        valid = self._demos[VALID_EVERY - 1 :: VALID_EVERY] or self._demos[1:][-1:]
        mask = self._file.create_group("mask")
        mask.create_dataset("train", data=np.array([demo for demo in self._demos if demo not in valid], dtype="S"))
        mask.create_dataset("valid", data=np.array(valid, dtype="S8"))
        self._file.close()
        self._sink.check()
        self._sink.close()

    def abandon(self) -> None:
        """Close a file that was not finished."""
        if self._file:
            self._file.close()
        self._sink.close()


def _key(camera: Camera) -> str:
    """Return the name of the observation; robomimic knows the modality by the configuration."""
    name = camera.name.removesuffix("_depth")
    return f"{name}_depth" if camera.depth else f"{name}_image"


def _shown(layout: dict[str, Any]) -> str:
    cameras = [f"{key} {size[1]}x{size[0]}" for key, size in layout.items() if key != "joints"]
    return ", ".join([*layout["joints"], *cameras])
