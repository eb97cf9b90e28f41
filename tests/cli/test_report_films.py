"""Films of a report: what the cameras saw when something went wrong."""

import base64
import re

import cv2
import numpy as np
import pytest

from common import messages as m
from recording.report import clips
from tests.cli.run_tape import Tape, report

BALL = {"shape": "sphere", "pose": m.Pose(position=m.Vector3(x=0.5, y=0.2, z=0.03))}


@pytest.fixture
def tape(tmp_path):
    return Tape(tmp_path / "run.mcap")


def films_of(page):
    found = []
    for address in re.findall(r'<img src="data:image/webp;base64,([^"]+)"', page.text):
        read, animation = cv2.imdecodeanimation(np.frombuffer(base64.b64decode(address), np.uint8))
        assert read
        found.append(animation)
    return found


def fail(tape, *times):
    for k, at in enumerate([0, *times]):
        tape.task(at, "GRASPING", failures=k)


def test_failures_close_to_each_other_have_one_film(tape):
    tape.task(0, "GRASPING", started=True)
    tape.put(2.2, "motion/status", m.MotionStatus(id="a", state="active"))
    tape.put(2.2, "motion/status", m.MotionStatus(id="a", state="aborted", message="joint 3 is 0.2 rad off"))
    tape.task(2.5, "DONE", started=True, failures=4)
    tape.images(60, 0.1)
    tape.image(2.05, 0, data=b"few")
    tape.image(2.15, 0, width=200)
    page = tape.report()
    (film,) = films_of(page)
    assert "2.20 s: motion aborted: joint 3 is 0.2 rad off" in page.text
    assert len(film.frames) == 22, "0.2 s apart, from 0 to 4.2 s"
    assert film.frames[0].shape[:2] == (200, 360)
    lefts = [np.flatnonzero(frame[100, :, 0] > 128)[0] for frame in film.frames]
    assert lefts == pytest.approx([10 * k for k in range(22)], abs=2)
    assert set(film.durations[:-1]) == {200}


def test_only_images_of_a_film_are_decoded_and_each_film_has_its_own_size(tape, monkeypatch):
    decoded, scaled = [], clips._scaled
    monkeypatch.setattr(clips, "_scaled", lambda message: decoded.append(message) or scaled(message))
    fail(tape, 10, 50)
    for k in range(60):
        tape.image(k, k, *((100, 80) if k < 30 else (80, 60)))
    tape.truncate()
    found = films_of(report(tape.path))
    assert [film.frames[0].shape[:2] for film in found] == [(80, 100), (60, 80), (60, 80)]
    assert len(decoded) == 2 * 7 + 5, "from 4 s before to 2 s after, and the end of an unfinished run"


def test_tall_images_are_scaled_and_the_number_of_cameras_is_limited(tape):
    fail(tape, 2)
    for k in range(3):
        for camera in range(clips.MOST_CAMERAS + 3):
            tape.image(k, 0, 1, 16384, str(camera), np.full((16384, 1, 3), 100 * k, np.uint8).tobytes())
    found = films_of(tape.report())
    assert [(len(film.frames), film.frames[0].shape[:2]) for film in found] == [(3, (480, 1))] * clips.MOST_CAMERAS


def test_failure_before_the_recording_has_no_film(tape):
    for k in range(2):  # states are repeated each second
        tape.put(0.1 + k, "motion/status", m.MotionStatus(id="a", state="aborted", message="old", error="limit"))
        tape.task(0.2 + k, "ERROR", target="ball_0", failures=3)
    tape.task(5, "GRASPING", failures=3)
    tape.put(8, "motion/status", m.MotionStatus(id="b", state="rejected", message="new", error="limit"))
    tape.images(20, 0.5)
    assert tape.report().captions == ["8.00 s: motion rejected: new"]


def test_object_lost_on_the_floor_is_listed_and_filmed_before_retries(tape):
    fail(tape, 1, 5, 10, 15)
    for t in range(30):  # ball_2 lay there before
        states = {"ball_0": "contained", "ball_1": "table" if t < 20 else "elsewhere", "ball_2": "elsewhere"}
        tape.put(t, "scene_objects", m.WorldObjects(objects=[
            m.WorldObject(id=name, shape="sphere", pose=m.Pose(position=m.Vector3(x=0.9, y=0.2 * k, z=-0.5)),
                          state=state) for k, (name, state) in enumerate(states.items())]))
    tape.images(30, 1)
    page = tape.report()
    lost = "lies elsewhere, at (0.900, 0.200, -0.500)"
    assert page.captions == ["1.00 s: GRASPING", f"20.00 s: ball_1 {lost}", "29.00 s: it ends GRASPING"]
    assert page.table("problems") == [["20.00", "lost, by truth", "ball_1", lost]]


def test_finished_run_with_an_unexplained_object_has_a_film_of_its_end(tape):
    tape.task(0, "GRASPING", started=True)
    tape.put(0, "scene_objects", m.WorldObjects(objects=[m.WorldObject(id="ball_0", state="table", **BALL)]))
    tape.task(8, "DONE", started=True)
    tape.images(10, 1)
    page = tape.report()
    assert len(films_of(page)) == 1
    assert "8.00 s: DONE but left at (0.500, 0.200, 0.030): not reported by the task" in page.text


@pytest.mark.parametrize("state", ["PLACING", "IDLE"])
def test_unfinished_run_has_a_film_of_its_end(tape, state):
    for t, label in ((0, "IDLE"), (1, "GRASPING"), (8, state)):
        tape.task(t, label, started=True)
    tape.images(10, 1)
    assert tape.report().captions == [f"9.00 s: it ends {state}"]


def test_idle_run_without_failures_has_no_film(tape):
    tape.task(0, "IDLE")
    tape.images(10, 0.1)
    assert not films_of(tape.report())
