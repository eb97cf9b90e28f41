"""Samples for the tests of recordings."""

import errno
import os
from pathlib import Path
from typing import Any

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


def joints(number: int, **kwargs: Any) -> Sample:
    """Return the joint states of one instant, received 1 ms later."""
    log_time = START + number * STEP
    if "payload" not in kwargs:
        header = Header(stamp=log_time - 1_000_000, frame_id="world")
        message = JointState(header=header, name=["a", "b"], position=[0.1 * number, 1.0], velocity=[1.0, -1.0])
        kwargs["payload"] = packed(message)
    return Sample(**{
        "key": "panda/joint_states", "log_time": log_time, "message": "JointState",
        "kind": "stream", "writer": "executor.1", "sequence": number + 1, "trace": f"{number:016x}", **kwargs})


def status(number: int, state: str = "IDLE", **kwargs: Any) -> Sample:
    log_time = START + number * STEP
    message = PickPlaceStatus(header=Header(stamp=log_time), state=state, placed=number)
    return Sample(**{
        "key": "panda/pick_place_status", "payload": packed(message), "log_time": log_time, "kind": "state",
        "message": "PickPlaceStatus", "writer": "task.1", "sequence": number + 1, **kwargs})


def write(path: Path, samples: list[Sample], *, every: int = 10, ended: dict[str, Any] | None = None) -> Path:
    """Write a recording with a chunk for each so many samples."""
    writer = RecordingWriter(path, {"cell": "panda", "made": "today"})
    for number, sample in enumerate(samples, 1):
        writer.add(sample)
        if number % every == 0:
            writer.flush()
    writer.close({"reason": "test", **(ended or {})})
    return path


def fill_disk(monkeypatch: pytest.MonkeyPatch, room: int, number: int = errno.ENOSPC) -> None:
    """Let the disk take this many bytes of recordings; of a larger write it takes the part that fits."""
    real = os.write

    def limited(file: int, data: memoryview) -> int:
        nonlocal room
        if room == 0 and len(data):
            raise OSError(number, os.strerror(number))
        taken = real(file, data[:room])
        room -= taken
        return taken

    monkeypatch.setattr(writer.os, "write", limited)
