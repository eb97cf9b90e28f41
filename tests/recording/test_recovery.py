"""A file that was cut anywhere gives back every chunk before the cut."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recording.reader import Recording, recover
from recording.sample import RecordingError
from recording.summary import summarise
from tests.recording.samples import fill_disk, joints, places, status, write

SAMPLES = [f(n) for n in range(60) for f in (joints, status)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recovery")


@pytest.fixture(scope="module")
def whole(folder: Path) -> bytes:
    return write(folder / "whole.mcap", SAMPLES, every=10).read_bytes()


@pytest.fixture(scope="module")
def ends(folder: Path, whole: bytes) -> list[int]:
    """Where the chunks end."""
    with Recording(folder / "whole.mcap") as recording:
        return [place.offset + place.length for place in recording.layout.chunks]


@pytest.fixture(scope="module")
def names(folder: Path) -> list[Path]:
    return [path for path, _ in zip(places(folder), range(4), strict=False)]


def saved_of(names: list[Path], content: bytes) -> tuple[int, bool]:
    source, target = names[0], names[1]
    source.write_bytes(content)
    target.unlink(missing_ok=True)
    recovered = recover(source, target)
    with Recording(target) as recording:
        assert recording.finished
        assert summarise(recording).messages == recovered.messages
        assert [(s.payload, s.sequence, s.trace) for s in recording.samples()] == [
            (s.payload, s.sequence, s.trace) for s in SAMPLES[: recovered.messages]]
    return recovered.messages, recovered.was_finished


@given(data=st.data())
def test_file_truncated_anywhere_keeps_all_complete_chunks(
    data: st.DataObject, whole: bytes, ends: list[int], names: list[Path]
) -> None:
    cut = data.draw(st.integers(0, len(whole)))
    messages, finished = saved_of(names, whole[:cut])
    assert messages == 10 * sum(end <= cut for end in ends)
    assert finished == (cut == len(whole))


def test_unfinished_file_is_read_up_to_its_end(whole: bytes, ends: list[int], folder: Path) -> None:
    path = folder / "unfinished.mcap"
    path.write_bytes(whole[: ends[3] + 5])
    with Recording(path) as recording:
        assert not recording.finished
        assert summarise(recording).messages == 40


@given(data=st.data())
def test_damaged_file_is_recovered_or_rejected(
    data: st.DataObject, whole: bytes, names: list[Path]
) -> None:
    content = bytearray(whole)
    for place in data.draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=5)):
        content[place] = data.draw(st.integers(0, 255))
    names[2].write_bytes(content)
    names[3].unlink(missing_ok=True)
    try:
        recovered = recover(names[2], names[3])
    except RecordingError as error:
        assert "\n" not in str(error)
        return
    with Recording(names[3]) as recording:
        assert recording.finished and recovered.messages == len(list(recording.samples()))


def test_recovery_skips_a_damaged_chunk(whole: bytes, ends: list[int], folder: Path) -> None:
    content = bytearray(whole)
    content[ends[4] - 20] ^= 0xFF
    source, target = folder / "damaged.mcap", folder / "mended.mcap"
    source.write_bytes(content)
    with Recording(source) as recording, pytest.raises(RecordingError, match=r"damaged at byte .*zencell recover"):
        list(recording.samples())
    recovered = recover(source, target)
    assert (recovered.damaged_chunks, recovered.messages) == (1, len(SAMPLES) - 10)


def test_zeros_after_the_last_chunk_are_no_records(whole: bytes, ends: list[int], names: list[Path]) -> None:
    assert saved_of(names, whole[: ends[1]] + bytes(5000))[0] == 20


def test_recovery_overwrites_no_file(whole: bytes, folder: Path) -> None:
    with pytest.raises(RecordingError, match="exists already"):
        recover(folder / "whole.mcap", folder / "whole.mcap")
    assert (folder / "whole.mcap").read_bytes() == whole


def test_recovery_on_a_full_disk_leaves_no_file(
    whole: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    source.write_bytes(whole)
    fill_disk(monkeypatch, 600)
    with pytest.raises(RecordingError, match=r"b.mcap: cannot be written, the disk is full; the incomplete file was"):
        recover(source, target)
    assert list(tmp_path.iterdir()) == [source]
