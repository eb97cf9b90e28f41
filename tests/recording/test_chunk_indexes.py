"""The index of chunks is read back from the file: a recorder needs no memory for it."""

import mcap.writer
import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from recording.chunk_indexes import ChunkIndexes
from tests.recording.samples import joints, status, write


@pytest.mark.parametrize("every", [1, 7, 1000])
def test_index_of_a_file_is_that_of_mcap(tmp_path, monkeypatch, every):
    made = []

    def remembered(**fields):
        made.append(ChunkIndex(**fields))
        return made[-1]

    monkeypatch.setattr(mcap.writer, "ChunkIndex", remembered)
    samples = [each for number in range(40) for each in (joints(number), status(number))]
    with write(tmp_path / "run.mcap", samples, every=every).open("rb") as file:
        found = make_reader(file).get_summary().chunk_indexes
    assert found == made and len(found) == max(-(-80 // every), 1)


def test_writer_holds_no_entry_of_a_chunk(tmp_path):
    held = []
    install = ChunkIndexes.install

    def watched(self, writer):
        install(self, writer)
        held.append(writer)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ChunkIndexes, "install", watched)
        write(tmp_path / "run.mcap", [joints(number) for number in range(40)], every=1)
    assert isinstance(vars(held[0])["_Writer__chunk_indices"], ChunkIndexes)
