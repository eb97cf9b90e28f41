"""Between network and disk: nothing blocks, drops are counted, and a full disk ends the recording with one line."""

import errno
import os
import threading
from random import Random

import pytest

from recording.capture import MAX_KEYS, Sink
from recording.reader import Recording
from recording.sample import MOST_WRITERS, RecordingError, Sequences
from recording.writer import SplitWriter, WriteFailed
from tests.recording.samples import fill_disk, joints, status


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.mcap"


def test_samples_beyond_the_queue_are_dropped_and_counted(path):
    disk, written_to = threading.Event(), threading.Event()

    class Stalled(SplitWriter):
        def add(self, sample):
            written_to.set()
            disk.wait()
            return super().add(sample)

    sink = Sink(Stalled(path, {}), max_bytes=3 * len(joints(0).payload) + 1)
    sink.offer(joints(0))
    assert written_to.wait(10)  # the first is on its way to the disk and still counts
    for number in range(1, 6):
        sink.offer(joints(number))
    assert sink.stats.dropped == {"panda/joint_states": 3}
    disk.set()
    assert sink.close({}).messages == 3
    with Recording(path) as recording:
        assert recording.metadata("ended")["dropped"] == {"panda/joint_states": 3}


def test_invented_keys_and_writers_do_not_stop_the_recording(path):
    sink, payload = Sink(SplitWriter(path, {"cell": "panda"})), joints(0).payload
    sink.offer(joints(0))
    for number in range(33_000):
        sink.offer(joints(1 + 2 * number, payload=payload, writer=f"liar.{number}"))
        sink.offer(joints(2 + 2 * number, payload=payload, key=f"panda/made/up/{number}"))
    sink.offer(joints(200_000))
    sink.offer(joints(200_001, writer="executor.2"))  # was restarted
    stats = sink.close({"reason": "test"})
    assert stats.messages + sum(stats.dropped.values()) == 66_003 and len(stats.dropped) == MAX_KEYS + 1
    with Recording(path) as recording:
        writers = [sample.writer for sample in recording.samples() if sample.key == "panda/joint_states"]
    assert len(writers) == 33_003 and writers[-3:] == ["", "executor.1", ""]


def test_most_recent_of_invented_writers_are_remembered():
    sequences = Sequences()
    for number in range(MOST_WRITERS + 10):
        for sequence in (1, 5):
            assert sequences.is_new(f"key {number}", f"liar.{number}", sequence)
        assert sequences.is_new("panda/joint_states", "executor.1", number + 1)
    assert not sequences.is_new("panda/joint_states", "executor.1", MOST_WRITERS)
    assert len(sequences._newest) == MOST_WRITERS and len(sequences.missed) == 1000


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_full_disk_ends_the_recording_and_leaves_complete_chunks(path, monkeypatch, number):
    failed = threading.Event()
    sink = Sink(SplitWriter(path, {"cell": "panda"}), on_failure=failed.set)
    fill_disk(monkeypatch, 40_000, number)
    while not failed.wait(0.001):
        for _ in range(10):
            sink.offer(joints(0, payload=os.urandom(5000)))
    with pytest.raises(WriteFailed, match=r"a.mcap: recording stopped, the disk is full; .*zencell recover") as error:
        sink.close({})
    assert error.value.exit_code == 1 and "\n" not in str(error.value)
    with Recording(path) as recording:
        assert not recording.finished
        assert recording.layout.complete == recording.layout.size <= 40_000
    sink.offer(joints(0))  # later samples are dropped


def test_failure_while_closing_is_raised(path, monkeypatch):
    sink = Sink(SplitWriter(path, {}))
    sink.offer(status(0))
    fill_disk(monkeypatch, 0, errno.EIO)
    with pytest.raises(WriteFailed, match="Input/output error"):
        sink.close({})


@pytest.mark.parametrize("missing", [0, 1])  # bytes that the end of the first file lacks, or the start of the next one
def test_full_disk_at_the_start_of_the_next_file_is_reported(tmp_path, monkeypatch, missing):
    def record(name: str) -> None:
        sink = Sink(SplitWriter(tmp_path / name, {"cell": "panda"}, max_bytes=1_000_000))
        for number in range(4):
            sink.offer(joints(number, payload=Random(number).randbytes(600_000)))
        sink.close({})

    record("a.mcap")
    fill_disk(monkeypatch, (tmp_path / "a_0.mcap").stat().st_size - missing)
    with pytest.raises(WriteFailed, match=r"b_[01].mcap: recording stopped, the disk is full"):
        record("b.mcap")
    (tmp_path / "c_1.mcap").touch()
    monkeypatch.undo()
    with pytest.raises(RecordingError, match=r"c_1.mcap: exists already"):
        record("c.mcap")


def test_bug_in_the_writing_thread_is_raised(path):
    class Broken(SplitWriter):
        def add(self, sample):
            raise RuntimeError("a bug")

    failed = threading.Event()
    sink = Sink(Broken(path, {}), on_failure=failed.set)
    sink.offer(joints(0))
    assert failed.wait(10)
    with pytest.raises(RuntimeError, match="a bug"):
        sink.close({})
