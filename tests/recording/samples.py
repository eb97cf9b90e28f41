"""Samples for the tests of recordings."""

import errno
import os
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import msgpack
import pytest

from applications.pick_place.topics import PickPlaceStatus
from common.messages import Header, JointState, Message
from recording import writer
from recording.sample import Sample
from recording.writer import RecordingWriter

START = 1_700_000_000_000_000_000  # [ns]
STEP = 10_000_000  # [ns]


def packed(message: Message) -> bytes:
    return msgpack.packb(message.model_dump(), use_bin_type=True)


def joints(number: int, **kwargs: object) -> Sample:
    """The joint states at one instant; they were on their way for 1 ms."""
    log_time = START + number * STEP
    header = Header(stamp=log_time - 1_000_000, frame_id="world")
    message = JointState(header=header, name=["a", "b"], position=[0.1 * number, 1.0], velocity=[1.0, -1.0])
    values = {
        "key": "panda/joint_states", "payload": packed(message), "log_time": log_time, "message": "JointState",
        "kind": "stream", "writer": "executor.1", "sequence": number + 1, "trace": f"{number:016x}",
    }
    return Sample(**{**values, **kwargs})


def status(number: int, state: str = "IDLE", **kwargs: object) -> Sample:
    log_time = START + number * STEP
    message = PickPlaceStatus(header=Header(stamp=log_time), state=state, placed=number)
    values = {
        "key": "panda/pick_place_status", "payload": packed(message), "log_time": log_time, "kind": "state",
        "message": "PickPlaceStatus", "writer": "task.1", "sequence": number + 1,
    }
    return Sample(**{**values, **kwargs})


def write(path: Path, samples: list[Sample], *, every: int = 10) -> Path:
    """A recording with a chunk for each so many samples."""
    writer = RecordingWriter(path, {"cell": "panda", "made": "today"})
    for number, sample in enumerate(samples, 1):
        writer.add(sample)
        if number % every == 0:
            writer.flush()
    writer.close({"reason": "test"})
    return path


def fill_disk(monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    """Have the disk take so many bytes [B] of recordings, and no more."""
    real = os.write

    def limited(file: int, data: memoryview) -> int:
        nonlocal room
        if len(data) > room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        room -= len(data)
        return real(file, data)

    monkeypatch.setattr(writer.os, "write", limited)


def places(folder: Path) -> Iterator[Path]:
    """Names of files that are not there yet."""
    for number in count():
        yield folder / f"{number}.mcap"
