"""Recordings are read as they were written, by zencell and by the reader of the mcap library."""

import json
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from common.messages import JointState
from common.remapping import is_cell
from recording.reader import Recording
from recording.sample import RecordingError, Sample, Sequences, encoding_of, message_of
from recording.summary import summarise
from recording.writer import RecordingWriter, SplitWriter
from tests.recording.samples import START, STEP, joints, status, write

texts = st.text(st.characters(codec="utf-8", exclude_characters="/"), min_size=1, max_size=8)
anything = st.builds(
    Sample, key=texts.map(lambda text: f"panda/{text}"), payload=st.binary(max_size=200),
    log_time=st.integers(1, 2**62), publish_time=st.integers(1, 2**62), message=st.sampled_from(["", "Image", "Mine"]),
    kind=st.sampled_from(["stream", "event", "state"]), writer=texts, sequence=st.integers(0, 2**32 - 1),
    trace=st.sampled_from(["", "abc"]),
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.mcap"


@given(st.lists(anything, max_size=30, unique_by=lambda s: (s.key, s.writer, s.sequence)), st.integers(1, 7))
def test_samples_are_read_as_they_were_written(tmp_path_factory, samples, every):
    path = write(tmp_path_factory.mktemp("files") / "a.mcap", samples, every=every)
    with Recording(path) as recording:
        assert recording.finished and recording.cell == "panda"
        assert list(recording.samples()) == samples


def test_payloads_are_plain_msgpack_with_the_schema_of_their_class(path):
    with write(path, [joints(0), status(1)]).open("rb") as file:
        reader = make_reader(file)
        found = {channel.topic: (schema, channel, message) for schema, channel, message in reader.iter_messages()}
        summary = reader.get_summary()
    schema, channel, message = found["panda/joint_states"]
    assert (schema.name, schema.encoding, channel.message_encoding) == ("JointState", "jsonschema", "msgpack")
    assert json.loads(schema.data) == JointState.model_json_schema()
    assert message.data == joints(0).payload
    assert (message.log_time, message.publish_time, message.sequence) == (START, START - 1_000_000, 1)
    assert channel.metadata == {"kind": "stream", "writer": "executor.1"}
    assert summary.statistics.message_count == 3  # with the one that holds the traces
    assert message_of("application/msgpack;Image") == "Image" and message_of("zenoh/bytes") == ""
    assert (encoding_of("Image"), encoding_of("")) == ("application/msgpack;Image", "application/msgpack")


def test_samples_are_selected_by_topic_and_time(path):
    with Recording(write(path, [f(n) for n in range(30) for f in (joints, status)], every=6)) as recording:
        found = list(recording.samples(lambda topic: topic == "joint_states", START + 20 * STEP))
        assert [sample.sequence for sample in found] == list(range(21, 31))
        assert recording.seconds == pytest.approx(0.29)


def test_truncated_file_is_read_selectively_once_its_channels_are_known(path, monkeypatch):
    writer = RecordingWriter(path, {"cell": "panda"})
    for number in range(20):
        writer.add(joints(number))
        writer.flush()
    writer.abandon()
    read = []
    with Recording(path) as recording:
        records = recording._records
        monkeypatch.setattr(recording, "_records", lambda place: read.append(place) or records(place))
        for attempt, most in (("first", 20), ("again", 4)):
            read.clear()
            found = recording.samples(since=START + 8 * STEP, until=START + 11 * STEP)
            assert [sample.sequence for sample in found] == [9, 10, 11, 12], attempt
            assert len(read) == most


def test_states_before_a_time_are_the_newest_of_each_key_and_its_writers(path):
    restarted = status(3, writer="task.2", sequence=1)
    other = status(1, key="panda/gripper/state", message="GripperState")
    with Recording(write(path, [status(0), other, joints(2), restarted, status(4)], every=1)) as recording:
        assert [sample.writer for sample in recording.samples()] == [
            "task.1", "task.1", "executor.1", "task.2", "task.1"]
        found = recording.states_before(START + 4 * STEP)
        assert [(sample.key, sample.writer) for sample in found] == [
            ("panda/gripper/state", "task.1"), ("panda/pick_place_status", "task.2")]
        assert recording.states_before(START) == []


def test_each_file_of_a_split_recording_is_usable_alone(path):
    writer = SplitWriter(path, {"cell": "panda"}, max_bytes=6000)
    writer.describe("run", {"seed": 3})
    writer.add(status(0, "GRASPING"))
    for number in range(1, 40):
        writer.add(joints(number))
        writer.flush()
    writer.close({"reason": "test"})
    assert len(writer.files) > 2 and writer.files[0].name == "a_0.mcap"
    sequences: list[int] = []
    for file in writer.files:
        with Recording(file) as recording:
            first, *rest = recording.samples()
            assert recording.finished and recording.metadata("run") == {"seed": 3}
            assert first.payload == status(0, "GRASPING").payload
            assert all(START <= first.log_time <= sample.log_time for sample in rest)
            sequences += [sample.sequence for sample in rest]
    assert sequences == list(range(2, 41))
    assert writer.size == sum(file.stat().st_size for file in writer.files)


def test_existing_file_is_not_overwritten_and_other_files_are_rejected(path):
    with pytest.raises(RecordingError, match="no such file"):
        Recording(path)
    os.mkfifo(path.with_suffix(".pipe"))
    for other in (path.with_suffix(".pipe"), path.parent):
        with pytest.raises(RecordingError, match="is not a regular file"):
            Recording(other)
    with pytest.raises(RecordingError, match="exists already"):
        RecordingWriter(write(path, [joints(0)]), {})
    path.write_bytes(b"hello world")
    with pytest.raises(RecordingError, match="is no MCAP file"):
        Recording(path)


def test_summary_counts_messages_and_losses_by_topic(path):
    lost = {"dropped": {"panda/joint_states": 2}, "missed": {"panda/camera/image_raw": 3}}
    with Recording(write(path, [joints(number) for number in range(11)], ended=lost)) as recording:
        summary = summarise(recording)
    topic = summary.topics["joint_states"]
    assert (topic.messages, topic.type, topic.kind, topic.dropped) == (11, "JointState", "stream", 2)
    assert topic.hz == pytest.approx(100)
    assert topic.bytes == sum(len(joints(n).payload) for n in range(11))
    assert summary.topics["camera/image_raw"].missed == 3
    assert (summary.lost, summary.messages, summary.finished) == (5, 11, True)
    assert json.loads(json.dumps(summary.as_dict()))["topics"]["joint_states"]["writers"] == ["executor.1"]


@pytest.mark.parametrize("cell", ["panda", "1", "true", "null", "k\u00fcche", "a.b-c_2"])
def test_cell_name_is_read_as_text(path, cell):
    assert is_cell(cell)
    RecordingWriter(path, {"cell": cell}).close()
    with Recording(path) as recording:
        assert recording.cell == cell


def test_repetitions_are_dropped_and_gaps_counted():
    sequences = Sequences()
    assert [sequences.is_new("k", "w", n) for n in (5, 5, 6, 4, 9)] == [True, False, True, False, True]
    assert sequences.missed == {"k": 2}
    assert sequences.is_new("k", "restarted", 1)


def test_many_tiny_messages_can_be_read(path):
    tiny = joints(0, payload=b"\x80")
    with Recording(write(path, [tiny] * 60_000, every=60_000)) as recording:
        assert sum(1 for _ in recording.samples()) == 60_000


def test_tiny_messages_under_many_and_long_keys_can_be_read(path):
    writer, samples = RecordingWriter(path, {"cell": "panda"}), [
        joints(number, key=f"panda/made/up/{number}", payload=b"\x80") for number in range(2000)]
    for _ in range(12):
        assert all(map(writer.add, samples))
        writer.flush()
    assert not writer.add(joints(0, key="panda/made/up/0" + 500 * "p"))
    writer.close()
    with Recording(path) as recording:
        assert sum(1 for _ in recording.samples()) == 24_000
