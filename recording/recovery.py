"""Makes a whole file of one that was cut by a kill or a full disk, or damaged."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from recording.layout import DAMAGE, records_of
from recording.reading import Recording
from recording.sample import RecordingError
from recording.writing import ABOUT, ENDED, NotMade, RecordingWriter, WritingFailed


@dataclass(frozen=True)
class Recovered:
    """What was saved, and what was not."""

    messages: int
    seconds: float
    was_finished: bool
    lost_bytes: int  # after the last whole record
    damaged_chunks: int


def recover(source: Path, target: Path) -> Recovered:
    """What was saved of a recording into a new file that is whole and indexed.

    Every chunk that is whole in the source is in the target.

    Raises:
        RecordingError: the source is no recording, or the target is there already or cannot be written.
    """
    if target.exists():
        raise RecordingError(f"{target}: is there already; choose another name")
    beside = target.with_name(target.name + ".part")
    beside.unlink(missing_ok=True)
    try:
        with Recording(source) as recording:
            saved = _copy(recording, beside)
        beside.replace(target)
    except WritingFailed as error:
        raise NotMade(target, error.why) from None
    finally:
        beside.unlink(missing_ok=True)
    return saved


def _copy(recording: Recording, target: Path) -> Recovered:
    layout = recording.layout
    writer = RecordingWriter(target, recording.metadata(ABOUT))
    damaged = 0
    try:
        names = dict.fromkeys(record.name for record in layout.metadata if record.name != ABOUT)
        for name in names:
            writer.describe(name, recording.metadata(name))
        for place in layout.chunks:
            try:
                samples = list(recording.samples_of(records_of(recording.file, place)))
            except DAMAGE:
                damaged += 1
                continue
            for sample in samples:
                writer.add(sample)
    except BaseException:
        writer.abandon()
        raise
    lost = layout.size - layout.whole
    ended = {} if recording.finished else {"reason": "cut", "lost_bytes": lost}
    writer.close({**recording.metadata(ENDED), **ended, "recovered": True, "damaged_chunks": damaged})
    return Recovered(writer.messages, recording.seconds, recording.finished, 0 if recording.finished else lost, damaged)
