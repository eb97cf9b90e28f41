"""A file truncated anywhere gives back every chunk before its end."""

import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from recording.reader import Recording, recover
from recording.sample import RecordingError
from recording.summary import summarise
from tests.recording.samples import fill_disk, joints, status, write

SAMPLES = [f(n) for n in range(60) for f in (joints, status)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("recovery")


@pytest.fixture(scope="module")
def whole(folder):
    return write(folder / "whole.mcap", SAMPLES, every=10).read_bytes()


@pytest.fixture(scope="module")
def ends(folder, whole):
    """Return the end of each chunk."""
    with Recording(folder / "whole.mcap") as recording:
        return [place.offset + place.length for place in recording.layout.chunks]


def recovered(folder: Path, content: bytes) -> tuple[int, bool, int]:
    """Return the number of messages, whether the file was finished, and the number of damaged chunks."""
    source, target = folder / "source.mcap", folder / "target.mcap"
    source.write_bytes(content)
    target.unlink(missing_ok=True)
    result = recover(source, target)
    with Recording(target) as recording:
        assert recording.finished
        samples = list(recording.samples())
        assert summarise(recording).messages == result.messages == len(samples)
        if not result.damaged_chunks:
            assert [(s.payload, s.sequence, s.trace) for s in samples] == [
                (s.payload, s.sequence, s.trace) for s in SAMPLES[: result.messages]]
    return result.messages, result.was_finished, result.damaged_chunks


@given(data=st.data())
def test_file_truncated_anywhere_keeps_all_complete_chunks(data, whole, ends, folder):
    cut = data.draw(st.integers(0, len(whole)))
    assert recovered(folder, whole[:cut]) == (10 * sum(end <= cut for end in ends), cut == len(whole), 0)


def test_unfinished_file_is_read_up_to_its_end(whole, ends, folder):
    path = folder / "unfinished.mcap"
    path.write_bytes(whole[: ends[3] + 5])
    with Recording(path) as recording:
        assert not recording.finished
        assert summarise(recording).messages == 40
    assert recovered(folder, whole[: ends[1]] + bytes(5000))[0] == 20, "zeros after the last chunk are no records"


@given(data=st.data())
def test_damaged_file_is_recovered_or_rejected(data, whole, folder):
    content = bytearray(whole)
    for place in data.draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=5)):
        content[place] = data.draw(st.integers(0, 255))
    source, target = folder / "any.mcap", folder / "saved.mcap"
    source.write_bytes(content)
    target.unlink(missing_ok=True)
    try:
        result = recover(source, target)
    except RecordingError as error:
        assert "\n" not in str(error)
        return
    with Recording(target) as recording:
        assert recording.finished and result.messages == len(list(recording.samples()))


def test_damaged_chunk_is_skipped(whole, ends, folder):
    content = bytearray(whole)
    content[ends[4] - 20] ^= 0xFF
    assert recovered(folder, bytes(content)) == (len(SAMPLES) - 10, True, 1)
    with (Recording(folder / "source.mcap") as recording,
          pytest.raises(RecordingError, match=r"damaged at byte .*zencell recover")):
        list(recording.samples())


@pytest.mark.parametrize(("holes", "lost"), [
    ([("chunk", 4, 60)], [4]), ([("chunk", 2, 5), ("chunk", 7, 9), ("chunk", 9, 300)], [2, 7, 9]),
    ([("byte", 0, 8)], []), ([("byte", 0, 120)], [0]), ([("end", 0, 200)], [11]), ([("footer", 0, 40)], []),
    ([("byte", 0, 120), ("chunk", 5, 9), ("end", 0, 50)], [0, 5, 11]),
], ids=str)
@pytest.mark.parametrize("filler", [b"\0", b"\xff", b"\x06"])
def test_chunks_behind_a_hole_are_saved(holes, lost, filler, whole, ends, folder):
    content = bytearray(whole)
    with Recording(folder / "whole.mcap") as recording:
        starts = [place.offset - 9 for place in recording.layout.chunks]
    for kind, number, size in holes:
        first = {"chunk": starts[number], "byte": 0, "end": ends[-1] - 50, "footer": len(whole) - size}[kind]
        content[first : first + size] = filler * size
    source, target = folder / "holes.mcap", folder / "filled.mcap"
    source.write_bytes(content)
    target.unlink(missing_ok=True)
    result = recover(source, target)
    with Recording(target) as recording:
        found = [(sample.payload, sample.sequence) for sample in recording.samples()]
    assert found == [(s.payload, s.sequence) for n, s in enumerate(SAMPLES) if n // 10 not in lost]
    assert result.damaged_chunks + len(result.holes) + bool(result.lost_bytes) >= len(holes)


@pytest.fixture(scope="module")
def loose(folder):
    """Return a file without chunks, as rosbag2 writes it with `fastwrite`."""
    path = folder / "loose.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/chatter", "cdr", schema, {"qos": "reliable"})
        for number in range(1000):
            writer.add_message(channel, 1_000_000 + number, bytes([0, 1, 0, 0]) + bytes(number), number + 1, number)
        writer.finish()
    return path.read_bytes()


@pytest.mark.parametrize(("damage", "lost", "holes"), [
    (lambda data: data, 0, 0),
    (lambda data: data[:200_000] + bytes(5000) + data[205_000:], 10, 1),
    (lambda data: bytes(2000) + data[2000:], 50, 1),
    (lambda data: data[:300_000], 280, 0),
    (lambda data: data[:300_000] + data[300_001:], 5, 1),
])
def test_file_without_chunks_is_read_and_copied_with_its_encodings(loose, folder, damage, lost, holes):
    source, target = folder / "damaged.mcap", folder / "chunked.mcap"
    source.write_bytes(damage(loose))
    target.unlink(missing_ok=True)
    with Recording(source) as recording:
        numbers = [sample.sequence for sample in recording.samples()]
        assert recording.topics() == {"chatter": ("std_msgs/msg/String", "stream")}
        assert recording.finished == (not lost) and len(recording.layout.holes) == holes
    assert numbers == sorted(set(numbers)) and 0 <= 1000 - len(numbers) <= lost
    assert recover(source, target).messages == len(numbers)
    with target.open("rb") as file:
        copied = [(m.sequence, len(m.data), c.topic, c.message_encoding, c.metadata, s.name, s.encoding, s.data)
                  for s, c, m in make_reader(file).iter_messages()]
    about = "/chatter", "cdr", {"qos": "reliable"}, "std_msgs/msg/String", "ros2msg", b"string data\n"
    assert copied == [(number, number + 4, *about) for number in numbers]


def test_record_that_does_not_parse_is_a_hole(folder):
    path = folder / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        for topic in ("panda/bad", "panda/good"):
            writer.add_message(writer.register_channel(topic, "msgpack", 0), 1, b"\x80", 1)
        writer.finish()
    path.write_bytes(path.read_bytes().replace(b"bad", b"\xff\xfe\xfd"))
    with Recording(path) as recording:
        assert [sample.topic for sample in recording.samples()] == ["good"]


def test_search_for_records_ends_at_once_in_a_file_made_to_prolong_it(whole, folder):
    path = folder / "endless.mcap"
    for filler in (b"\x06\x28\0\0\0\0\0\0\0", b"\x05\x16" + bytes(7) + b"\1" * 22 + b"\xff"):
        path.write_bytes(whole[:60] + b"\xff" * 9 + filler * 400_000)
        with path.open("r+b") as file:
            file.truncate(2**40)  # sparse
        before = time.process_time()
        with Recording(path) as recording:
            assert not recording.finished and not recording.layout.chunks
        assert time.process_time() - before < 3


def test_recovery_overwrites_no_file_and_leaves_none_on_a_full_disk(whole, tmp_path, monkeypatch):
    source = tmp_path / "a.mcap"
    source.write_bytes(whole)
    with pytest.raises(RecordingError, match="exists already"):
        recover(source, source)
    fill_disk(monkeypatch, 600)
    with pytest.raises(RecordingError, match=r"b.mcap: cannot be written, the disk is full; the incomplete file was"):
        recover(source, tmp_path / "b.mcap")
    assert list(tmp_path.iterdir()) == [source] and source.read_bytes() == whole
