"""`zencell export REC... --lerobot FOLDER` and `--hdf5 FILE`: recordings as aligned episodes, and what they lack."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from common.errors import ConfigError
from common.terminal import Progress, printable
from recording.datasets.alignment import Choice
from recording.datasets.episode import (
    ACTIONS,
    GRIPPER,
    MAX_FPS,
    MAX_GAP,
    NEXT_STATE,
    SET_POINTS,
    Episode,
    align,
    camera_topics,
    rate_of,
    read_streams,
)
from recording.datasets.lerobot import LeRobotWriter
from recording.datasets.robomimic import RobomimicWriter
from recording.reader import Recording
from recording.sample import Decoder
from recording.selection import Selection
from recording.writer import FULL, ExportFailed

RULES = {
    "times": "frame k is at start_ns + k / fps; header stamps, of images that of the exposure",
    "sample": "nearest stamp within half a period; otherwise the newest sample before the frame, counted as filled",
    "state": "positions of joint_states; gripper.width of gripper/state is the newest at or before the frame",
}
ACTION_RULES = {
    SET_POINTS: "newest of motion/set_points at or before the time of the next frame, fingers: the commanded width",
    NEXT_STATE: "state of the next frame; of the last frame its own",
}
NO_DEPTH = "  {}: depth left out, LeRobot v3.0 has no feature for it; --hdf5 has"


@dataclass(frozen=True)
class DatasetOptions:
    """Options of a data set, as the user gave them."""

    fps: str | None = None
    tasks: Sequence[str] = ()
    robot_type: str | None = None
    embed_images: bool = False
    max_gap: str | None = None
    actions: str | None = None


class Writer(Protocol):
    """Writes one format of data sets."""

    def add(self, recording: Recording, episode: Episode, task: str) -> None:
        """Append an episode."""

    def close(self, provenance: dict[str, Any]) -> None:
        """Finish the files."""

    def abandon(self) -> None:
        """Release files that were not finished."""


def write_lerobot(
    paths: Sequence[Path], folder: Path, selection: Selection, options: DatasetOptions, say: Callable[[str], None],
) -> None:
    """Write a LeRobotDataset v3.0 with an episode for each recording.

    Raises:
        ConfigError: the folder exists, or an option or a recording lacks something.
        RecordingError: a recording is damaged, or differs from the first.
    """
    _require_new_folder("--lerobot", folder)
    _write(paths, folder, selection, options, say,
           lambda part, fps, robot: LeRobotWriter(part, fps, robot, embed=options.embed_images), depth=False)


def write_robomimic(
    paths: Sequence[Path], file: Path, selection: Selection, options: DatasetOptions, say: Callable[[str], None],
) -> None:
    """Write an HDF5 file in robomimic's layout with a demonstration for each recording.

    Raises:
        ConfigError: an option or a recording lacks something.
        RecordingError: a recording is damaged, or differs from the first.
    """
    _write(paths, file, selection, options, say, lambda part, fps, robot: RobomimicWriter(part, fps), depth=True)


def _write(
    paths: Sequence[Path], target: Path, selection: Selection, options: DatasetOptions,
    say: Callable[[str], None], create: Callable[[Path, int, str], Writer], *, depth: bool,
) -> None:
    """Write all episodes to a hidden neighbor of the target, which gets its name once it is complete."""
    max_gap, actions = _number("--max-gap", options.max_gap, MAX_GAP), options.actions
    if actions not in (None, *ACTIONS):
        raise ConfigError("--actions", actions, f"choices: {', '.join(ACTIONS)}")
    tasks = list(options.tasks)
    if len(tasks) not in (0, 1, len(paths)):
        raise ConfigError("--task", tasks, f"must be one for all, or one for each of the {len(paths)} recordings")
    part = target.with_name(f".{target.name}.part")
    fps, writer, episodes = _fps(options.fps), None, list[dict[str, Any]]()
    without_depth = list[str]()
    try:
        for number, path in enumerate(paths):
            decoder = Decoder()
            with Progress(f"reading {path}") as read, Recording(path, read) as recording:
                selection.require_in(recording.topics(), path, "--topics")
                streams = read_streams(recording, camera_topics(recording, selection), decoder)
                if not depth:
                    without_depth = [camera.topic for camera in streams.cameras if camera.depth]
                    streams = replace(streams, cameras=tuple(each for each in streams.cameras if not each.depth))
                fps = fps or _camera_rate(streams.cameras, path)
                episode = align(recording, streams, fps, max_gap, actions)
                actions = episode.actions  # of the first recording for all
                robot = options.robot_type or episode.cell or "unknown"
                writer = writer or create(part, fps, robot)
                task = (tasks[min(number, len(tasks) - 1)] if tasks else "") or f"run the cell {episode.cell}"
                writer.add(recording, episode, task)
            for line in [*report(number, episode, task), *map(NO_DEPTH.format, without_depth)]:
                say(line)
            for topic, count in sorted((decoder.skipped + decoder.unfit).items()):
                say(f"  {printable(topic)}: {count:,} messages cannot be read, or have no stamp or pixels: left out")
            episodes.append(_provenance(episode, task))
        assert writer is not None  # the command requires a recording
        assert actions is not None
        writer.close({"rules": {**RULES, "action": ACTION_RULES[actions]}, "actions": actions, "episodes": episodes})
        part.replace(target)
    except OSError as error:
        raise ExportFailed(target, "the disk is full" if _is_full(error) else str(error)) from None
    finally:
        if writer is not None:
            writer.abandon()
        if part.is_dir():
            shutil.rmtree(part)
        part.unlink(missing_ok=True)
    frames = sum(each["frames"] for each in episodes)
    say(f"{target}: {len(episodes)} episodes, {frames:,} frames at {fps} Hz")


def _is_full(error: OSError) -> bool:
    return error.errno in FULL or "No space left" in str(error)  # HDF5 gives no number


def _require_new_folder(option: str, folder: Path) -> None:
    if folder.exists():
        raise ConfigError(option, str(folder), "exists already; choose another name")
    if not folder.absolute().parent.is_dir():
        raise ConfigError(option, str(folder), "is in a folder that does not exist")


def _number(option: str, text: str | None, default: float) -> float:
    try:
        value = default if text is None else float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise ConfigError(option, text, "must be a number above 0")
    return value


def _fps(text: str | None) -> int | None:
    if text is None:
        return None
    value = _number("--fps", text, 0.0)
    if value != int(value) or value > MAX_FPS:
        raise ConfigError("--fps", text, f"must be a whole number from 1 to {MAX_FPS}")
    return int(value)


def _camera_rate(cameras: Sequence[Any], path: Path) -> int:
    found = rate_of(cameras)
    if found is None:
        raise ConfigError("--fps", ..., f"is needed: {path} has no camera whose rate could be taken")
    return min(found, MAX_FPS)


def report(number: int, episode: Episode, task: str) -> list[str]:
    """Return what an episode has, with the time error of each column, as lines."""
    seconds = (int(episode.times[-1]) - int(episode.times[0])) * 1e-9
    lines = [f"episode {number}: {episode.path}: {len(episode):,} frames, {seconds:.1f} s, task: {printable(task)}"]
    for topic, choice in episode.choices.items():
        lines.append(f"  {topic}: {_error(choice, len(episode))}" if topic != GRIPPER
                     else f"  {topic}: newest value at or before each frame")
    for topic, seconds in episode.ended_early.items():
        lines.append(f"  {topic}: ended {seconds:.1f} s before the recording; there are no frames after it")
    lines.append(f"  action: {ACTION_RULES[episode.actions]}")
    if episode.intervention is not None:
        lines.append(f"  intervention: an operator had control in {int(episode.intervention.sum())} frames")
    return lines


def _error(choice: Choice, frames: int) -> str:
    chosen = np.abs(choice.error_ns[~choice.filled]) * 1e-6
    text = f"time error {np.median(chosen):.2f} ms median, {chosen.max():.2f} ms at most; " if len(chosen) else ""
    filled = int(choice.filled.sum())
    oldest = f" (oldest {np.abs(choice.error_ns[choice.filled]).max() * 1e-9:.3f} s)" if filled else ""
    return f"{text}{filled} of {frames} frames filled with the sample before{oldest}; {choice.unused} samples unused"


def _provenance(episode: Episode, task: str) -> dict[str, Any]:
    streams = {
        topic: {
            "max_error_ms": float(np.abs(choice.error_ns[~choice.filled]).max(initial=0)) * 1e-6,
            "filled_frames": np.flatnonzero(choice.filled).tolist(), "unused_samples": choice.unused,
        } for topic, choice in episode.choices.items() if topic != GRIPPER
    }
    return {"recording": episode.path.name, "cell": episode.cell, "task": task, "frames": len(episode),
            "start_ns": int(episode.times[0]), "streams": streams}
