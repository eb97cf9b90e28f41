"""Between network and disk: nothing blocks, what is dropped is counted, a full disk ends it with one line."""

import errno
import os
import threading
from pathlib import Path
from random import Random

import pytest

from recording.reader import Recording
from recording.sample import MOST_WRITERS, RecordingError, Sequences
from recording.sink import MAX_KEYS, Sink
from recording.writer import SplitWriter, WriteFailed
from tests.recording.samples import fill_disk, joints, status


def test_all_samples_are_written_with_the_reason_of_the_end(tmp_path: Path) -> None:
    writer = SplitWriter(tmp_path / "a.mcap", {"cell": "panda"})
    sink = Sink(writer)
    sink.describe("run", {"seed": 7})
    for number in range(100):
        sink.offer(joints(number))
    figures = sink.close({"reason": "test"})
    assert (figures.messages, figures.dropped, figures.size) == (100, {}, (tmp_path / "a.mcap").stat().st_size)
    with Recording(tmp_path / "a.mcap") as recording:
        assert len(list(recording.samples())) == 100
        assert recording.metadata("run") == {"seed": 7}
        assert recording.metadata("ended") == {"reason": "test", "dropped": {}}


def test_samples_beyond_the_queue_are_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, written_to = threading.Event(), threading.Event()

    class Stalled(SplitWriter):
        def add(self, sample):
            written_to.set()
            disk.wait()
            return super().add(sample)

    size = len(joints(0).payload)
    sink = Sink(Stalled(tmp_path / "a.mcap", {}), max_bytes=3 * size + 1)
    sink.offer(joints(0))
    assert written_to.wait(10)  # the first is on its way to the disk and still counts
    for number in range(1, 6):
        sink.offer(joints(number))
    assert sink.stats.dropped == {"panda/joint_states": 3}
    disk.set()
    assert sink.close({}).messages == 3
    with Recording(tmp_path / "a.mcap") as recording:
        assert recording.metadata("ended")["dropped"] == {"panda/joint_states": 3}


def test_invented_keys_and_writers_do_not_stop_the_recording(tmp_path: Path) -> None:
    sink = Sink(SplitWriter(tmp_path / "a.mcap", {"cell": "panda"}))
    sink.offer(joints(0))
    for number in range(33_000):
        sink.offer(joints(1 + 2 * number, writer=f"liar.{number}"))
        sink.offer(joints(2 + 2 * number, key=f"panda/made/up/{number}"))
    sink.offer(joints(200_000))
    sink.offer(joints(200_001, writer="executor.2"))  # was started again
    figures = sink.close({"reason": "test"})
    assert figures.messages + sum(figures.dropped.values()) == 66_003 and len(figures.dropped) == MAX_KEYS + 1
    with Recording(tmp_path / "a.mcap") as recording:
        states = [sample for sample in recording.samples() if sample.key == "panda/joint_states"]
    assert len(states) == 33_003
    assert [sample.writer for sample in states[-3:]] == ["", "executor.1", ""]


def test_of_invented_writers_the_most_recent_are_remembered() -> None:
    sequences = Sequences()
    for number in range(MOST_WRITERS + 10):
        for sequence in (1, 5):
            assert sequences.is_new(f"key {number}", f"liar.{number}", sequence)
        assert sequences.is_new("panda/joint_states", "executor.1", number + 1)
    assert not sequences.is_new("panda/joint_states", "executor.1", MOST_WRITERS)
    assert len(sequences._newest) == MOST_WRITERS and len(sequences.missed) == 1000


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_full_disk_ends_the_recording_and_leaves_complete_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    writer = SplitWriter(tmp_path / "a.mcap", {"cell": "panda"})
    failed = threading.Event()
    sink = Sink(writer, on_failure=failed.set)
    real, room = os.write, 40_000

    def write(file: int, data: memoryview) -> int:
        nonlocal room
        if room == 0:
            raise OSError(number, os.strerror(number))
        taken = min(room, len(data))
        room -= taken
        return real(file, data[:taken])  # a disk that fills takes the part that still fits

    monkeypatch.setattr(os, "write", write)
    offered = 0
    while not failed.wait(0.001):
        for _ in range(10):
            sink.offer(joints(offered, payload=os.urandom(5000)))
            offered += 1
    with pytest.raises(WriteFailed, match=r"a.mcap: recording stopped, the disk is full; .*zencell recover") as error:
        sink.close({})
    assert error.value.exit_code == 1 and "\n" not in str(error.value)
    with Recording(tmp_path / "a.mcap") as recording:
        assert not recording.finished
        assert recording.layout.complete == recording.layout.size <= 40_000
    sink.offer(joints(0))  # later samples are dropped


def test_failure_while_closing_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sink = Sink(SplitWriter(tmp_path / "a.mcap", {}))
    sink.offer(status(0))

    def write(file: int, data: memoryview) -> int:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "write", write)
    with pytest.raises(WriteFailed, match="Input/output error"):
        sink.close({})


@pytest.mark.parametrize("missing", [0, 1])  # bytes that the end of the first file lacks, or the start of the next one
def test_disk_full_at_the_start_of_the_next_file_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: int
) -> None:
    def recorded(name: str) -> None:
        sink = Sink(SplitWriter(tmp_path / name, {"cell": "panda"}, max_bytes=1_000_000))
        for number in range(4):
            sink.offer(joints(number, payload=Random(number).randbytes(600_000)))
        sink.close({})

    recorded("a.mcap")
    fill_disk(monkeypatch, (tmp_path / "a_0.mcap").stat().st_size - missing)
    with pytest.raises(WriteFailed, match=r"b_[01].mcap: recording stopped, the disk is full"):
        recorded("b.mcap")


def test_existing_next_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a_1.mcap").touch()
    sink = Sink(SplitWriter(tmp_path / "a.mcap", {"cell": "panda"}, max_bytes=1_000_000))
    for number in range(4):
        sink.offer(joints(number, payload=os.urandom(600_000)))
    with pytest.raises(RecordingError, match=r"a_1.mcap: exists already"):
        sink.close({})


def test_bug_in_the_writing_thread_is_raised(tmp_path: Path) -> None:
    class Broken(SplitWriter):
        def add(self, sample):
            raise RuntimeError("a bug")

    failed = threading.Event()
    sink = Sink(Broken(tmp_path / "a.mcap", {}), on_failure=failed.set)
    sink.offer(joints(0))
    assert failed.wait(10)
    with pytest.raises(RuntimeError, match="a bug"):
        sink.close({})
