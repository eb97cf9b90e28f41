"""What was said is found again by when it was, within bounds of time and memory; recordings answer in the same way."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from page.timeline import Timeline

from common import messages as m
from common import topics
from common.messages import Message
from common.perception.image import array_to_image, image_to_array
from common.topics import Topic
from page import history as past_module
from page.history import MOST_BYTES, SECONDS, RecentHistory
from page.recorded_history import EventDetector, RecordedHistory, recordings_in
from recording.sample import RecordingError, Sample
from recording.writer import RecordingWriter

NAMES = {"DONE": "Done"}


def joints(value: float) -> m.JointState:
    return m.JointState(header=m.Header(stamp=1), name=["a"], position=[value], velocity=[0.0])


def task(state: str, subject: str = "") -> m.TaskStatus:
    return m.TaskStatus(header=m.Header(stamp=1), state=state, subject=subject)


def test_newest_message_of_a_time_is_found_and_what_is_older_than_the_last_minutes_is_gone() -> None:
    memory = RecentHistory()
    for step in range(6000):
        memory.note(step * 0.1, topics.JOINT_STATES, joints(step))
    for at in (500.0, 555.55, 599.0):
        state = memory.latest(topics.JOINT_STATES, at)
        assert state is not None and state.position[0] == pytest.approx(int(at * 10 + 1e-6), abs=1)
    assert (memory.start, memory.end) == (599.9 - SECONDS, 599.9)
    kept = memory.between(topics.JOINT_STATES, 0.0, 1000.0)
    assert len(kept) <= SECONDS / 0.08 + 3 and kept[0][0] >= 599.9 - SECONDS - 0.2


def test_the_newest_of_a_stream_is_there_though_few_are_kept() -> None:
    memory = RecentHistory()
    for step in range(3001):
        memory.note(step * 0.01, topics.JOINT_STATES, joints(step))
    last = memory.latest(topics.JOINT_STATES, 30.0)
    assert last is not None and last.position == [3000]
    assert len(memory.between(topics.JOINT_STATES, -1.0, 30.0)) <= 30 / 0.08 + 2


def test_a_state_that_stays_is_known_for_as_long_as_it_stays() -> None:
    memory, scene = RecentHistory(), m.PlanningScene(header=m.Header(stamp=1))
    assert memory.note(0.0, topics.PLANNING_SCENE, scene)
    assert not memory.note(500.0, topics.PLANNING_SCENE, scene)
    assert memory.latest(topics.PLANNING_SCENE, 400.0) is scene


def test_what_is_looked_back_at_is_what_was_said_and_the_same_as_long_as_it_is_looked_at() -> None:
    memory = RecentHistory()
    for step in range(100):
        memory.note(float(step), topics.JOINT_STATES, joints(step))
    found = memory.latest(topics.JOINT_STATES, 41.5)
    assert found == joints(41) and memory.latest(topics.JOINT_STATES, 41.7) is found
    assert memory.latest(topics.JOINT_STATES, 42.0) == joints(42)


def test_of_large_messages_fewer_minutes_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(past_module, "MOST_TOLD", 10_000)
    memory = RecentHistory()
    for step in range(1000):
        memory.note(step * 0.1, topics.JOINT_STATES, joints(step))
    kept = memory.between(topics.JOINT_STATES, -1.0, 100.0)
    assert kept[-1][1] == joints(999) and 50 < len(kept) == len({at for at, _ in kept}) < 200
    assert memory.latest(topics.JOINT_STATES, 50.0) is None


def test_pictures_take_no_more_memory_than_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(past_module, "MOST_BYTES", 200_000)
    memory, rng = RecentHistory(), np.random.default_rng(0)
    for step in range(60):
        memory.note_picture(float(step), topics.CAMERA_IMAGE, rng.integers(0, 255, (120, 160, 3), dtype=np.uint8))
    assert 0 < memory._bytes <= 200_000 < MOST_BYTES
    assert memory.picture(topics.CAMERA_IMAGE, 5.0) is None
    assert memory.picture(topics.CAMERA_IMAGE, 59.0) is not None


def test_picture_that_is_kept_looks_as_it_did() -> None:
    memory, red = RecentHistory(), np.zeros((48, 64, 3), np.uint8)
    red[..., 0] = 220
    memory.note_picture(1.0, topics.CAMERA_IMAGE, red)
    found = image_to_array(memory.picture(topics.CAMERA_IMAGE, 2.0))
    assert found[24, 32].tolist() == pytest.approx([0, 0, 220], abs=8)


@pytest.fixture
def timeline() -> Timeline:
    memory = RecentHistory()
    for step in range(1001):
        memory.note(step * 0.1, topics.JOINT_STATES, joints(step))
    for at, words in ((20.0, "Taking"), (50.0, "Placing")):
        memory.happened(at, words)
    return Timeline(lambda topic: joints(-1.0), memory)  # type: ignore[arg-type, return-value]


def at(timeline: Timeline) -> float:
    state = timeline.latest(topics.JOINT_STATES)
    assert state is not None
    return state.position[0]


def test_who_looks_at_now_is_told_what_is_said_now(timeline: Timeline) -> None:
    assert at(timeline) == -1
    timeline.seek(30.0)
    assert at(timeline) == 300
    timeline.now()
    assert at(timeline) == -1


def test_playing_goes_on_at_its_speed_until_it_is_now(timeline: Timeline) -> None:
    timeline.step(0.0)
    timeline.seek(30.0)
    timeline.step(1.0)
    assert at(timeline) == 300
    timeline.playing, timeline.speed = True, 2.0
    timeline.step(6.0)
    assert at(timeline) == 400
    timeline.step(60.0)
    assert timeline.is_now and at(timeline) == -1


def test_events_are_jumped_to_in_both_directions(timeline: Timeline) -> None:
    def jump(step: int) -> str:
        event = timeline.event(step)
        if event is None:
            return ""
        timeline.seek(event.at)
        return event.words

    assert [jump(-1), jump(-1), jump(-1), jump(1), jump(1)] == ["Placing", "Taking", "", "Placing", ""]


def test_what_task_and_motion_say_becomes_events_once() -> None:
    watch = EventDetector(NAMES)
    assert watch.news(task("GRASPING", "ball_1")) == [("Grasping ball_1", "")]
    assert watch.news(task("GRASPING", "ball_1")) == []
    assert watch.news(task("DONE")) == [("Done", "good")]
    aborted = m.MotionStatus(id="g", state="aborted", error="path_tolerance", message="0.1 rad off")
    assert watch.news(aborted) == [("motion aborted: 0.1 rad off", "bad")]
    assert watch.news(aborted) == [] and watch.news(m.MotionStatus(id="h", state="active")) == []


class Shelf(RecentHistory):
    """Something to look back at that cannot be read from some time on."""

    def __init__(self) -> None:
        super().__init__()
        self._begun, self.now, self.asked = 0.0, 10.0, 0

    def picture(self, topic: Topic[Any], at: float) -> Any:
        self.asked += 1
        if at > 5.0:
            raise RecordingError("run.mcap: is damaged")
        return at


def test_picture_is_given_once_for_a_time_and_what_is_damaged_is_told(timeline: Timeline) -> None:
    shelf, told = Shelf(), []
    timeline.told = told.append
    assert timeline.picture(topics.CAMERA_IMAGE) is None
    timeline.open(shelf)
    timeline.seek(3.0)
    assert [timeline.picture(topics.CAMERA_IMAGE) for _ in range(3)] == [3.0, None, None]
    timeline.picture_anew()
    assert timeline.picture(topics.CAMERA_IMAGE) == 3.0 and shelf.asked == 2
    timeline.seek(6.0)
    assert [timeline.picture(topics.CAMERA_IMAGE) for _ in range(3)] == [None] * 3
    assert told == ["run.mcap: is damaged"]


def recording(path: Path, cell: str = "panda") -> Path:
    writer = RecordingWriter(path, {"cell": cell})

    def add(topic: Topic[Any], seconds: float, message: Message) -> None:
        writer.add(Sample(f"{cell}/{topic.key}", msgpack.packb(message.model_dump()), round(1e18 + seconds * 1e9),
                          message=type(message).__name__, kind=topic.kind, writer="w", sequence=1))

    for step in range(101):
        add(topics.JOINT_STATES, step * 0.1, joints(step))
        if step % 10 == 0:
            add(topics.CAMERA_IMAGE, step * 0.1, array_to_image(np.full((8, 8, 3), step, np.uint8), "bgr8"))
    add(topics.MOTION_STATUS, 10.0, m.MotionStatus(id="g", state="aborted", error="limit"))
    writer.close()
    return path


def test_recording_answers_as_the_last_minutes_do(tmp_path: Path) -> None:
    path = recording(tmp_path / "run.mcap")
    wanted = [topics.JOINT_STATES, topics.CAMERA_IMAGE, topics.MOTION_STATUS]
    past = RecordedHistory(path, "panda", wanted, NAMES)
    try:
        assert (past.start, past.end) == (0.0, pytest.approx(10.0))
        state = past.latest(topics.JOINT_STATES, 5.04)
        assert state is not None and state.position == [50]
        assert past.latest(topics.JOINT_STATES, 5.04) is state
        assert len(past.between(topics.JOINT_STATES, 2.0, 4.0)) == pytest.approx(20, abs=1)
        assert image_to_array(past.picture(topics.CAMERA_IMAGE, 5.5))[0, 0, 0] == 50
        assert past.picture(topics.CAMERA_IMAGE, 0.0) is not None
        assert past.picture(topics.DEPTH_CAMERA_IMAGE, 5.0) is None
        assert [(event.at, event.words) for event in past.events] == [(pytest.approx(10.0), "motion aborted: limit")]
    finally:
        past.close()


def test_what_came_after_the_clock_was_set_back_is_there(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", {"cell": "panda"})
    for number, second in enumerate((0.0, 1.0, 30.0, 2.0, 3.0)):
        writer.add(Sample("panda/joint_states", msgpack.packb(joints(second).model_dump()), round(1e18 + second * 1e9),
                          message="JointState", kind="stream", writer="w", sequence=number))
    writer.close()
    past = RecordedHistory(tmp_path / "run.mcap", "panda", [topics.JOINT_STATES], NAMES)
    try:
        for second in (1.0, 2.0, 3.0, 30.0):
            assert past.latest(topics.JOINT_STATES, second + 0.1) == joints(second)
    finally:
        past.close()


def test_message_of_another_class_than_its_topic_has_is_none(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", {"cell": "panda"})
    for second, message in enumerate((joints(1.0), task("DONE"))):
        writer.add(Sample("panda/joint_states", msgpack.packb(message.model_dump()), round(1e18 + second * 1e9),
                          message=type(message).__name__, kind="stream", writer="w", sequence=second))
    writer.close()
    past = RecordedHistory(tmp_path / "run.mcap", "panda", [topics.JOINT_STATES], NAMES)
    try:
        assert past.latest(topics.JOINT_STATES, 0.5) == joints(1.0)
        assert past.latest(topics.JOINT_STATES, 1.0) is None
        assert [at for at, _ in past.between(topics.JOINT_STATES, -1.0, 2.0)] == [0.0]
    finally:
        past.close()


def test_recording_of_another_cell_is_refused(tmp_path: Path) -> None:
    path = recording(tmp_path / "run.mcap", "ur5")
    with pytest.raises(RecordingError, match=r"run.mcap: is of the cell ur5, not of panda"):
        RecordedHistory(path, "panda", [topics.JOINT_STATES], NAMES)


def test_recordings_of_a_folder_are_offered_the_newest_first(tmp_path: Path) -> None:
    for age, name in enumerate(("new.mcap", "old.mcap", "note.txt")):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    assert recordings_in(tmp_path) == ["new.mcap", "old.mcap"]
    assert recordings_in(tmp_path / "nowhere") == []
