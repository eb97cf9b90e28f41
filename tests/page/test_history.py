"""History of the last minutes within its bounds of time and memory, recordings, and the timeline over both."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from common import messages as m
from common import topics
from common.messages import Message
from common.perception.image import array_to_image, image_to_array
from common.topics import Topic
from page import history as history_module
from page.history import MAX_IMAGE_BYTES, SECONDS, RecentHistory, Timeline
from page.recorded_history import EventDetector, RecordedHistory, recordings_in
from recording.sample import RecordingError, Sample
from recording.writer import RecordingWriter

NAMES = {"DONE": "Done"}


def joints(value: float) -> m.JointState:
    return m.JointState(header=m.Header(stamp=1), name=["a"], position=[value], velocity=[0.0])


def task(state: str, subject: str = "") -> m.TaskStatus:
    return m.TaskStatus(header=m.Header(stamp=1), state=state, subject=subject)


def filled(count: int, period: float) -> RecentHistory:
    """Return a history of joint states whose values are their numbers."""
    history = RecentHistory()
    for step in range(count):
        history.add(step * period, topics.JOINT_STATES, joints(step))
    return history


def test_newest_message_at_a_time_is_found_within_the_last_minutes() -> None:
    history = filled(6000, 0.1)
    for at in (500.0, 555.55, 599.0):
        state = history.latest(topics.JOINT_STATES, at)
        assert state.position[0] == pytest.approx(int(at * 10 + 1e-6), abs=1)
        assert history.latest(topics.JOINT_STATES, at) is state
    assert (history.start, history.end) == (599.9 - SECONDS, 599.9)
    stored = history.between(topics.JOINT_STATES, 0.0, 1000.0)
    assert len(stored) <= SECONDS / 0.08 + 3 and stored[0][0] >= 599.9 - SECONDS - 0.2


def test_fast_stream_is_thinned_out_but_its_newest_message_is_there() -> None:
    history = filled(3001, 0.01)
    assert history.latest(topics.JOINT_STATES, 30.0) == joints(3000)
    assert len(history.between(topics.JOINT_STATES, -1.0, 30.0)) <= 30 / 0.08 + 2


def test_unchanged_state_is_stored_once_and_found_at_any_time() -> None:
    history, scene = RecentHistory(), m.PlanningScene(header=m.Header(stamp=1))
    assert history.add(0.0, topics.PLANNING_SCENE, scene)
    assert not history.add(500.0, topics.PLANNING_SCENE, scene)
    assert history.latest(topics.PLANNING_SCENE, 400.0) is scene


def test_large_messages_are_stored_for_a_shorter_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_module, "MAX_TOPIC_BYTES", 10_000)
    history = filled(1000, 0.1)
    stored = history.between(topics.JOINT_STATES, -1.0, 100.0)
    assert stored[-1][1] == joints(999) and 50 < len(stored) == len({at for at, _ in stored}) < 200
    assert history.latest(topics.JOINT_STATES, 50.0) is None


def test_images_have_their_colors_and_are_bounded_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_module, "MAX_IMAGE_BYTES", 200_000)
    history, rng = RecentHistory(), np.random.default_rng(0)
    for step in range(60):
        history.add_image(float(step), topics.CAMERA_IMAGE, rng.integers(0, 255, (120, 160, 3), dtype=np.uint8))
    assert 0 < history._image_bytes <= 200_000 < MAX_IMAGE_BYTES
    assert history.image(topics.CAMERA_IMAGE, 5.0) is None
    red = np.zeros((48, 64, 3), np.uint8)
    red[..., 0] = 220
    history.add_image(60.0, topics.CAMERA_IMAGE, red)
    found = image_to_array(history.image(topics.CAMERA_IMAGE, 61.0))
    assert found[24, 32].tolist() == pytest.approx([0, 0, 220], abs=8)


# --- timeline ---


@pytest.fixture
def timeline() -> Timeline:
    history = filled(1001, 0.1)
    for at, text in ((20.0, "Grasping"), (50.0, "Placing")):
        history.add_event(at, text)
    return Timeline(lambda topic: joints(-1.0), history)


def value(timeline: Timeline) -> float:
    state = timeline.latest(topics.JOINT_STATES)
    return state.position[0]


def test_playback_advances_at_its_speed_up_to_the_present(timeline: Timeline) -> None:
    assert value(timeline) == -1
    timeline.step(0.0)
    timeline.seek(30.0)
    timeline.step(1.0)
    assert value(timeline) == 300
    timeline.playing, timeline.speed = True, 2.0
    timeline.step(6.0)
    assert value(timeline) == 400
    timeline.step(60.0)
    assert timeline.is_present and value(timeline) == -1
    timeline.seek(30.0)
    timeline.return_to_present()
    assert value(timeline) == -1


def test_adjacent_events_are_found_in_both_directions(timeline: Timeline) -> None:
    def jump(direction: int) -> str:
        event = timeline.adjacent_event(direction)
        if event is None:
            return ""
        timeline.seek(event.at)
        return event.text

    assert [jump(-1), jump(-1), jump(-1), jump(1), jump(1)] == ["Placing", "Grasping", "", "Placing", ""]


def test_events_are_detected_once() -> None:
    detector = EventDetector(NAMES)
    assert detector.detect(task("GRASPING", "ball_1")) == [("Grasping ball_1", "")]
    assert detector.detect(task("GRASPING", "ball_1")) == []
    assert detector.detect(task("DONE")) == [("Done", "good")]
    aborted = m.MotionStatus(id="g", state="aborted", error="path_tolerance", message="0.1 rad off")
    assert detector.detect(aborted) == [("motion aborted: 0.1 rad off", "bad")]
    assert detector.detect(aborted) == [] and detector.detect(m.MotionStatus(id="h", state="active")) == []


def test_image_is_returned_once_per_time_and_damage_is_reported(timeline: Timeline) -> None:
    damaged, errors, reads = RecentHistory(), [], []

    def read(_topic: object, at: float) -> float:
        reads.append(at)
        if at > 5.0:
            raise RecordingError("run.mcap: is damaged")
        return at

    damaged._started, damaged.now, damaged.image = 0.0, 10.0, read
    timeline.on_error = errors.append
    assert timeline.image(topics.CAMERA_IMAGE) is None
    timeline.open(damaged)
    timeline.seek(3.0)
    assert [timeline.image(topics.CAMERA_IMAGE) for _ in range(3)] == [3.0, None, None]
    timeline.resend_images()
    assert timeline.image(topics.CAMERA_IMAGE) == 3.0 and len(reads) == 2
    timeline.seek(6.0)
    assert [timeline.image(topics.CAMERA_IMAGE) for _ in range(3)] == [None] * 3
    assert errors == ["run.mcap: is damaged"]


# --- recordings ---

Open = Callable[..., RecordedHistory]


@pytest.fixture
def record(tmp_path: Path) -> Iterator[Open]:
    """Writes messages, each with topic and time [s], to a recording, and opens it."""
    opened: list[RecordedHistory] = []

    def record_and_open(*messages: tuple[Topic[Any], float, Message], cell: str = "panda") -> RecordedHistory:
        path = tmp_path / "run.mcap"
        writer = RecordingWriter(path, {"cell": cell})
        for number, (topic, second, message) in enumerate(messages):
            writer.add(Sample(f"{cell}/{topic.key}", msgpack.packb(message.model_dump()), round(1e18 + second * 1e9),
                              message=type(message).__name__, kind=topic.kind, writer="w", sequence=number))
        writer.close()
        needed = [topics.JOINT_STATES, topics.CAMERA_IMAGE, topics.MOTION_STATUS]
        opened.append(RecordedHistory(path, "panda", needed, NAMES))
        return opened[-1]

    yield record_and_open
    for each in opened:
        each.close()


def test_recording_answers_like_the_last_minutes(record: Open) -> None:
    history = record(
        *((topics.JOINT_STATES, step * 0.1, joints(step)) for step in range(101)),
        *((topics.CAMERA_IMAGE, step * 0.1, array_to_image(np.full((8, 8, 3), step, np.uint8), "bgr8"))
          for step in range(0, 101, 10)),
        (topics.MOTION_STATUS, 10.0, m.MotionStatus(id="g", state="aborted", error="limit")))
    assert (history.start, history.end) == (0.0, pytest.approx(10.0))
    state = history.latest(topics.JOINT_STATES, 5.04)
    assert state.position == [50]
    assert history.latest(topics.JOINT_STATES, 5.04) is state
    assert len(history.between(topics.JOINT_STATES, 2.0, 4.0)) == pytest.approx(20, abs=1)
    assert image_to_array(history.image(topics.CAMERA_IMAGE, 5.5))[0, 0, 0] == 50
    assert history.image(topics.CAMERA_IMAGE, 0.0) is not None
    assert history.image(topics.DEPTH_CAMERA_IMAGE, 5.0) is None
    assert [(event.at, event.text) for event in history.events] == [(pytest.approx(10.0), "motion aborted: limit")]


def test_messages_after_the_clock_was_set_back_are_found_and_those_of_another_class_ignored(record: Open) -> None:
    times = (0.0, 1.0, 30.0, 2.0, 3.0)
    history = record(*((topics.JOINT_STATES, at, joints(at)) for at in times), (topics.JOINT_STATES, 5.0, task("DONE")))
    for at in (1.0, 2.0, 3.0, 30.0):
        assert history.latest(topics.JOINT_STATES, at + 0.1) == joints(at)
    assert history.latest(topics.JOINT_STATES, 5.1) is None
    assert [at for at, _ in history.between(topics.JOINT_STATES, -1.0, 40.0)] == pytest.approx(sorted(times))


def test_recording_of_another_cell_is_rejected(record: Open) -> None:
    with pytest.raises(RecordingError, match=r"run.mcap: is a recording of the cell ur5, not of panda"):
        record((topics.JOINT_STATES, 0.0, joints(1.0)), cell="ur5")


def test_recordings_of_a_folder_are_listed_newest_first(tmp_path: Path) -> None:
    for age, name in enumerate(("new.mcap", "old.mcap", "note.txt")):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    assert recordings_in(tmp_path) == ["new.mcap", "old.mcap"]
    assert recordings_in(tmp_path / "nowhere") == []
