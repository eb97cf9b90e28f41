"""A file truncated anywhere gives back every chunk before its end."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

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


def test_recovery_overwrites_no_file_and_leaves_none_on_a_full_disk(whole, tmp_path, monkeypatch):
    source = tmp_path / "a.mcap"
    source.write_bytes(whole)
    with pytest.raises(RecordingError, match="exists already"):
        recover(source, source)
    fill_disk(monkeypatch, 600)
    with pytest.raises(RecordingError, match=r"b.mcap: cannot be written, the disk is full; the incomplete file was"):
        recover(source, tmp_path / "b.mcap")
    assert list(tmp_path.iterdir()) == [source] and source.read_bytes() == whole
