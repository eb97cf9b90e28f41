"""Which sample a frame gets, and how far it is from the frame's time."""

from pathlib import Path

import numpy as np
import pytest

from recording.datasets.alignment import grid, in_force, nearest, phase
from recording.datasets.episode import WIDTH, align, camera_name, camera_topics, read_streams
from recording.reader import Recording
from recording.sample import Decoder, RecordingError
from recording.selection import Selection
from tests.recording.datasets import episodes
from tests.recording.datasets.episodes import FPS, MS, exposure, picture, position, recording
from tests.recording.samples import START

SECOND = 1000 * MS


def stamps(*milliseconds: float) -> np.ndarray:
    return np.array([round(each * MS) for each in milliseconds], np.int64)


def test_times_of_frames_have_no_accumulated_error():
    times = grid(START, START + 1000 * SECOND, 30)
    assert len(times) == 30_001 and times[30_000] == START + 1000 * SECOND
    assert np.abs(times - START - np.arange(30_001) * SECOND / 30).max() < 300


@pytest.mark.parametrize(("given", "index", "filled", "unused"), [
    ((0, 100, 200, 300), [0, 1, 2, 3], [0, 0, 0, 0], 0),
    ((0, 130, 160, 300), [0, 1, 2, 3], [0, 0, 0, 0], 0),
    ((0, 200, 300), [0, 0, 1, 2], [0, 1, 0, 0], 0),
    ((0, 151, 300), [0, 0, 1, 2], [0, 1, 0, 0], 0),
    ((0, 300), [0, 0, 0, 1], [0, 1, 1, 0], 0),
    ((0, 50, 100, 140, 200, 210, 300), [0, 2, 4, 6], [0, 0, 0, 0], 3),
    ((20, 100, 200), [0, 1, 2, 2], [0, 0, 0, 1], 0),
], ids=["regular", "jitter", "dropped", "late", "two dropped", "more samples than frames", "ends early"])
def test_frame_gets_the_nearest_sample_and_a_gap_moves_no_other_frame(given, index, filled, unused):
    times = stamps(0, 100, 200, 300)
    choice = nearest(stamps(*given), times, 10)
    assert choice.index.tolist() == index and choice.filled.tolist() == [bool(each) for each in filled]
    assert choice.unused == unused
    assert np.abs(choice.error_ns[~choice.filled]).max() <= 50 * MS
    assert (choice.error_ns[choice.filled] < 0).all()  # only with samples before


def test_state_in_force_is_never_of_the_future():
    choice = in_force(stamps(0, 190, 201), stamps(0, 100, 200, 300))
    assert choice.index.tolist() == [0, 0, 1, 2]


@pytest.mark.parametrize(("fps", "period"), [(10, 100), (30, 100), (10, 100 / 3), (5, 100)])
def test_one_late_first_exposure_does_not_put_the_grid_off(fps, period):
    given = stamps(*(0.3 * period if k == 0 else k * period for k in range(60)))
    offset = phase(given, fps) / MS
    assert abs(offset + 0.3 * min(period, 1000 / fps)) < 0.02 * period or fps == 30
    times = grid(int(given[0]) + round(offset * MS), int(given[-1]), fps)
    choice = nearest(given, times, fps)
    assert np.median(np.abs(choice.error_ns[~choice.filled])) < 1 * MS


def aligned(path: Path, fps: int = FPS, max_gap: float = 0.5, topics: tuple[str, ...] = ()):
    with Recording(path) as opened:
        selected = camera_topics(opened, Selection.of(topics))
        episode = align(opened, read_streams(opened, selected, Decoder()), fps, max_gap)
        return episode, {camera.topic: list(episode.pixels(opened, camera)) for camera in episode.cameras}


def test_episode_has_the_recorded_joints_of_the_arm_the_gripper_and_the_next_state_as_action(tmp_path):
    episode, images = aligned(recording(tmp_path / "a.mcap"))
    assert episode.names == ("a", "b", WIDTH) and len(episode) == 12
    closest = [START + round((t - START) / episodes.JOINTS_PERIOD) * episodes.JOINTS_PERIOD for t in episode.times]
    assert np.array_equal(episode.state[:, :2], [np.array(position(t))[[0, 2]] for t in closest])
    assert episode.state[:, 2].tolist() == [0.08 if t < START + 500 * MS else 0.02 for t in episode.times]
    assert np.array_equal(episode.action[:-1], episode.state[1:])
    assert np.array_equal(episode.action[-1], episode.state[-1])
    assert all(np.array_equal(found, picture(k)) for k, found in enumerate(images["camera/image_raw"]))
    assert np.abs(episode.choices["camera/image_raw"].error_ns).max() <= 2 * MS
    assert np.abs(episode.choices["joint_states"].error_ns).max() <= 5 * MS


def test_dropped_image_is_filled_with_the_one_before_and_later_frames_stay_in_place(tmp_path):
    episode, images = aligned(recording(tmp_path / "a.mcap", dropped=(4, 5)))
    shown = [int(found[0, -1, 1]) // 10 for found in images["camera/image_raw"]]
    assert shown == [0, 1, 2, 3, 3, 3, 6, 7, 8, 9, 10, 11]
    assert np.flatnonzero(episode.choices["camera/image_raw"].filled).tolist() == [4, 5]
    assert not episode.choices["joint_states"].filled.any()


def test_without_a_description_of_the_robot_every_joint_is_state(tmp_path):
    episode, _ = aligned(recording(tmp_path / "a.mcap", robot=False))
    assert episode.names == ("a", "finger", "b", WIDTH)


def test_gap_longer_than_the_limit_is_rejected(tmp_path):
    path = recording(tmp_path / "a.mcap", dropped=(3, 4, 5, 6))
    with pytest.raises(RecordingError, match=r"camera/image_raw has no sample for 0\.\d+ s before frame 6 .*--max-gap"):
        aligned(path, max_gap=0.35)
    assert len(aligned(path, max_gap=0.45)[0]) == 12


def test_images_that_arrive_in_another_order_have_the_order_of_exposure(tmp_path):
    samples = [episodes.joints(number) for number in range(60)]
    samples += [episodes.image(number, exposure(number)) for number in (1, 0, 3, 2, 4)]
    _, images = aligned(episodes.write(tmp_path / "a.mcap", samples))
    assert [int(found[0, -1, 1]) // 10 for found in images["camera/image_raw"]] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("topic", "name"), [
    ("camera/image_raw", "camera"), ("depth_camera/depth/image_raw", "depth_camera_depth"),
    ("detection_image", "detection_image"), ("wrist/left/image_raw", "wrist_left")])
def test_camera_is_named_by_its_topic(topic, name):
    assert camera_name(topic) == name
