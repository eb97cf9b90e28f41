"""One recording as an episode: joint positions, gripper, images and actions at a fixed rate.

- State: positions of the arm's joints, by joint_states, and the width of the gripper in force, by gripper/state. The
  joints are those of robot/description; without it, all of joint_states.
- Action of a frame, from set-points: what was commanded last at the time of the next frame, by motion/set_points.
  Before the first command of the gripper its width is that of the state.
- Action of a frame, from states: the state of the next frame; of the last its own.
- Intervention: whether an operator had taken over, by `control` of the status of a task that lets an operator do so.
- Times are header stamps: of images the exposure. See `alignment` for the choice of samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from common.messages import GripperState, Image, JointState, RobotDescription, SetPoints
from common.perception.image import ImageError
from recording.access import pixels_of
from recording.datasets.alignment import SECOND, Choice, Stamps, grid, in_force, nearest, phase
from recording.reader import Recording
from recording.sample import Decoder, RecordingError
from recording.selection import Selection
from recording.tables import Array

JOINTS, GRIPPER, ROBOT, COMMANDS = "joint_states", "gripper/state", "robot/description", "motion/set_points"
STATUS = "_status"  # end of the topics of tasks
CONTROL, OPERATOR = "control", "operator"  # field of the status of a task that an operator can take over, and its value
SET_POINTS, NEXT_STATE = ACTIONS = ("set-points", "next-state")
WIDTH = "gripper.width"
CAMERA_IMAGE = "image_raw"  # last part of the topics of cameras
DEPTHS = ("16UC1", "32FC1")  # encodings
MAX_FPS = 1000
MAX_GAP = 0.5  # [s] for which a frame may be filled with an earlier sample
LEAST_FRAMES = 2


@dataclass(frozen=True)
class Camera:
    """One topic of images; `stamps` of its readable images in ascending order, equal ones once."""

    topic: str
    name: str  # of its feature
    stamps: Stamps
    height: int
    width: int
    depth: bool


@dataclass(frozen=True)
class Streams:
    """What a recording has for an episode."""

    joints: tuple[str, ...]
    stamps: Stamps  # of the joint states
    positions: npt.NDArray[np.float64]  # (messages, joints) [rad or m]
    gripper_stamps: Stamps  # empty without gripper/state
    widths: npt.NDArray[np.float64]  # [m]
    cameras: tuple[Camera, ...]
    command_stamps: Stamps  # of the set-points; empty without them
    commands: npt.NDArray[np.float64]  # (messages, joints + 1) [rad or m], then the width [m]; NaN: not commanded
    control_stamps: Stamps  # of the status of a task with `control`; empty without one
    taken_over: npt.NDArray[np.bool_]  # by an operator


@dataclass(frozen=True)
class Episode:
    """Aligned frames of one recording; images are read on demand."""

    path: Path
    cell: str
    fps: int
    times: Stamps  # (frames,)
    names: tuple[str, ...]  # of the state
    state: npt.NDArray[np.float64]  # (frames, names) [rad or m]
    choices: dict[str, Choice]  # by topic
    cameras: tuple[Camera, ...]
    action: npt.NDArray[np.float64]  # (frames, names) [rad or m]
    actions: str  # one of ACTIONS
    intervention: npt.NDArray[np.bool_] | None  # (frames,) whether an operator had control; None: unknown
    ended_early: dict[str, float] = field(default_factory=dict)  # topics, and how long before the last one [s]

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.times)

    def pixels(self, recording: Recording, camera: Camera) -> Iterator[Array]:
        """Yield the image of each frame as RGB (height, width, 3) uint8, or depth (height, width) float32 [m].

        Raises:
            RecordingError: the recording is damaged.
        """
        wanted = camera.stamps[self.choices[camera.topic].index].tolist()
        needed, found = set(wanted), dict[int, Array]()
        images = _images(recording, camera.topic, Decoder())
        for now, following in pairwise([*wanted, None]):
            while now not in found:
                stamp, image = next(images)
                if stamp in needed and stamp not in found and (pixels := _pixels(image)) is not None:
                    found[stamp] = pixels
            yield found[now]
            if following != now:
                del found[now]
                needed.discard(now)


def camera_topics(recording: Recording, selection: Selection) -> list[str]:
    """Return the topics of images of an episode: the named ones, otherwise those of cameras."""
    found = {topic for topic, (message, _) in recording.topics().items() if message == "Image"}
    named = bool(selection.keys)
    return sorted(topic for topic in found
                  if selection.wants(topic) and (named or topic.rpartition("/")[2] == CAMERA_IMAGE))


def camera_name(topic: str) -> str:
    """Return the name of a camera: the topic without its last part, with underscores for slashes."""
    return topic.removesuffix(f"/{CAMERA_IMAGE}").replace("/", "_")


def read_streams(recording: Recording, topics: Sequence[str], decoder: Decoder) -> Streams:
    """Read the numbers of a recording, and the stamps of its images.

    Raises:
        ConfigError: it has no joint states, or a camera without images.
        RecordingError: it is damaged, or its joints or image sizes change.
    """
    stamps, joints, rows = list[int](), tuple[str, ...](), list[list[float]]()
    gripper_stamps, widths, arm = list[int](), list[float](), tuple[str, ...]()
    commands, control = list[SetPoints](), dict[int, bool]()
    for sample in recording.samples(
        lambda topic: topic in (JOINTS, GRIPPER, ROBOT, COMMANDS) or topic.endswith(STATUS)
    ):
        message = decoder.message(sample)
        if isinstance(message, RobotDescription):
            arm = tuple(message.joints)
        elif isinstance(message, GripperState):
            gripper_stamps.append(message.header.stamp)
            widths.append(message.width)
        elif isinstance(message, SetPoints):
            commands.append(message)
        elif isinstance(taken := getattr(message, CONTROL, None), str) and message is not None:
            control[_stamp(message)] = taken == OPERATOR
        elif isinstance(message, JointState) and message.header.stamp:
            if rows and tuple(message.name) != joints:
                raise RecordingError(f"{recording.path}: the joints of {JOINTS} change")
            joints = tuple(message.name)
            stamps.append(message.header.stamp)
            rows.append(message.position)
    if not rows:
        raise ConfigError(str(recording.path), ..., f"has no {JOINTS}, which a data set needs")
    order, gripper_order = _ascending(stamps), _ascending(gripper_stamps)
    positions = np.array(rows, np.float64)[order]
    chosen = [i for i, name in enumerate(joints) if name in arm] or list(range(len(joints)))
    names = tuple(joints[i] for i in chosen)
    command_order = _ascending([each.header.stamp for each in commands])
    commanded = [[*map(dict(zip(each.name, each.position, strict=True)).get, names), each.width] for each in commands]
    return Streams(
        names, np.array(stamps, np.int64)[order], positions[:, chosen],
        np.array(gripper_stamps, np.int64)[gripper_order], np.array(widths, np.float64)[gripper_order],
        tuple(_camera(recording, topic, decoder) for topic in topics),
        np.array([each.header.stamp for each in commands], np.int64)[command_order],
        np.array(commanded, np.float64).reshape(-1, len(names) + 1)[command_order],
        np.array(sorted(control), np.int64), np.array([control[stamp] for stamp in sorted(control)], np.bool_))


def _stamp(message: Any) -> int:
    """Return the stamp of a status, whose class need not be installed."""
    header = message.header
    return int(header["stamp"] if isinstance(header, dict) else header.stamp)


def _ascending(stamps: list[int]) -> npt.NDArray[np.intp]:
    """Return the order by stamp; of equal stamps the last that arrived."""
    order = np.argsort(np.array(stamps, np.int64), kind="stable")
    ordered = np.array(stamps, np.int64)[order]
    return order[np.append(ordered[1:] != ordered[:-1], True)] if len(order) else order


def _camera(recording: Recording, topic: str, decoder: Decoder) -> Camera:
    stamps, sizes, depth = set[int](), dict[tuple[int, int], None](), False
    for stamp, image in _images(recording, topic, decoder):
        if _pixels(image) is None:
            decoder.unfit[topic] += 1
            continue
        stamps.add(stamp)
        sizes[image.height, image.width] = None
        depth = image.encoding in DEPTHS
    if not stamps:
        raise ConfigError("--topics", topic, f"has no image in {recording.path} that this version can read")
    if len(sizes) > 1:
        listed = ", ".join(f"{width}x{height}" for height, width in sizes)
        raise RecordingError(f"{recording.path}: the size of {topic} changes: {listed}")
    height, width = next(iter(sizes))
    return Camera(topic, camera_name(topic), np.array(sorted(stamps), np.int64), height, width, depth)


def _images(recording: Recording, topic: str, decoder: Decoder) -> Iterator[tuple[int, Image]]:
    """Yield stamp and message of each image with a stamp; the decoder counts the others."""
    for sample in recording.samples(lambda name: name == topic):
        message = decoder.message(sample)
        if isinstance(message, Image) and message.header.stamp:
            yield message.header.stamp, message
        elif message is not None:
            decoder.unfit[topic] += 1


def _pixels(image: Image) -> Array | None:
    """Return the pixels of an image; None if they are invalid or of an unknown encoding."""
    try:
        return pixels_of(image)
    except ImageError:
        return None


def rate_of(cameras: Sequence[Camera]) -> int | None:
    """Return the rate of the first camera, the median rounded to a whole number [Hz]; None if it is below 1."""
    gaps = np.diff(cameras[0].stamps) if cameras else np.array([], np.int64)
    return round(1e9 / float(np.median(gaps))) or None if len(gaps) else None


def align(
    recording: Recording, streams: Streams, fps: int, max_gap: float, actions: str | None = None
) -> Episode:
    """Return the frames of a recording: from the first exposure with all streams to the end of the first that ends.

    Actions are set-points if the recording has any, unless `actions` is one of ACTIONS.

    Raises:
        ConfigError: the recording has no set-points, but `actions` requires them.
        RecordingError: there are too few frames, or a stream lacks samples for longer than `max_gap` [s].
    """
    timed = {JOINTS: streams.stamps, **{camera.topic: camera.stamps for camera in streams.cameras}}
    everything = [*timed.values(), *([streams.gripper_stamps] if len(streams.gripper_stamps) else [])]
    first, last = max(int(each[0]) for each in everything), min(int(each[-1]) for each in timed.values())
    main = streams.cameras[0].stamps if streams.cameras else streams.stamps
    later = main[main >= first]
    half = SECOND // (2 * fps)
    start = int(later[0]) + (phase(later, fps) if streams.cameras else 0) if len(later) else last + SECOND
    times = grid(start, last + half, fps)
    if len(times) < LEAST_FRAMES:
        listed = ", ".join(timed)
        raise RecordingError(f"{recording.path}: {listed} have no {LEAST_FRAMES} frames in common at {fps} Hz")
    choices = {topic: nearest(stamps, times, fps) for topic, stamps in timed.items()}
    for topic, choice in choices.items():
        worst = int(np.argmax(np.abs(choice.error_ns)))
        gap = abs(int(choice.error_ns[worst])) * 1e-9
        if choice.filled[worst] and gap > max_gap:
            at = (int(times[worst]) - int(times[0])) * 1e-9
            raise RecordingError(f"{recording.path}: {topic} has no sample for {gap:.2f} s before frame {worst} "
                                 f"({at:.2f} s), more than --max-gap {max_gap:g}")
    state, names = streams.positions[choices[JOINTS].index], streams.joints
    if len(streams.gripper_stamps):
        choices[GRIPPER] = in_force(streams.gripper_stamps, times)
        state = np.column_stack([state, streams.widths[choices[GRIPPER].index]])
        names = (*names, WIDTH)
    if actions == SET_POINTS and not len(streams.command_stamps):
        raise ConfigError("--actions", actions, f"needs {COMMANDS}, which {recording.path} lacks: use {NEXT_STATE}")
    actions = actions or (SET_POINTS if len(streams.command_stamps) else NEXT_STATE)
    intervention = None
    if len(streams.control_stamps):
        intervention = streams.taken_over[in_force(streams.control_stamps, times).index]
    return Episode(
        recording.path, recording.cell, fps, times, names, state, choices, streams.cameras,
        _actions(streams, times, state, fps, actions), actions, intervention, _ended_early(timed, max_gap))


def _ended_early(timed: dict[str, Stamps], max_gap: float) -> dict[str, float]:
    """Return the streams that ended more than `max_gap` [s] before the last one, and how long before [s]."""
    end = max(int(stamps[-1]) for stamps in timed.values())
    before = {topic: (end - int(stamps[-1])) * 1e-9 for topic, stamps in timed.items()}
    return {topic: seconds for topic, seconds in before.items() if seconds > max_gap}


def _actions(
    streams: Streams, times: Stamps, state: npt.NDArray[np.float64], fps: int, actions: str
) -> npt.NDArray[np.float64]:
    """Return the action of each frame (frames, names); what was not commanded is the next state."""
    found = np.concatenate([state[1:], state[-1:]])
    if actions == SET_POINTS:
        following = np.append(times[1:], times[-1] + SECOND // fps)
        commanded = streams.commands[in_force(streams.command_stamps, following).index, : state.shape[1]]
        found = np.where(np.isnan(commanded), found, commanded)
    return found
