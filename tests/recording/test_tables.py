"""Arrays of the messages of a topic, for programs."""

import tracemalloc

import numpy as np
import pytest

import zencell
from common.messages import Header, Pose, PoseArray, Vector3
from common.perception.image import array_to_image
from recording.sample import Sample
from recording.tables import column_of
from tests.recording.samples import START, STEP, joints, packed, status, write


def poses(number: int) -> Sample:
    message = PoseArray(header=Header(stamp=START + number), poses=[Pose(position=Vector3(x=number))])
    return Sample("panda/places", packed(message), START + number * STEP, message="PoseArray", writer="a",
                  sequence=number)


def image(number: int, side: int = 8) -> Sample:
    pixels = np.full((side, side, 3), (1, 2, number), np.uint8)
    message = array_to_image(pixels, "bgr8", Header(stamp=START + number))
    return Sample("panda/camera/image_raw", packed(message), START + number * STEP, message="Image", writer="c",
                  sequence=number)


def test_three_lines_give_arrays(tmp_path):
    write(tmp_path / "run.mcap", [joints(n) for n in range(5)])
    table = zencell.open_recording(tmp_path / "run.mcap").table("joint_states")
    assert table["a.position"].tolist() == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert table.time.tolist() == pytest.approx([0, 0.01, 0.02, 0.03, 0.04])
    assert table.stamp_ns.tolist() == [START + n * STEP - 1_000_000 for n in range(5)]
    assert table.log_time_ns.tolist() == [START + n * STEP for n in range(5)]
    assert table.names == ["header.frame_id", "a.position", "b.position", "a.velocity", "b.velocity"]
    assert table.matrix("*.velocity").tolist() == [[1, -1]] * 5 and len(table) == 5


def test_nested_fields_have_dotted_names_and_types(tmp_path):
    path = write(tmp_path / "run.mcap", [status(0, "IDLE"), status(1, "DONE"), poses(0), poses(1)])
    with zencell.open_recording(path) as run:
        table = run.table("pick_place_status")
        assert table["state"].tolist() == ["IDLE", "DONE"] and table["placed"].dtype == np.int64
        assert {"header.frame_id", "state", "placed"} < set(table.names) and "header.stamp" not in table.names
        assert run.topics == {"pick_place_status": "PickPlaceStatus", "places": "PoseArray"} and run.cell == "panda"
        assert [each[0]["position"]["x"] for each in run.table("places")["poses"]] == [0, 1]


@pytest.mark.parametrize(("values", "expected"), [
    ([1, 2], np.array([1, 2])), ([1, 2.5], np.array([1, 2.5])), ([True, False], np.array([True, False])),
    ([1, None], np.array([1, np.nan])), ([[1, 2], [3, 4.5]], np.array([[1, 2], [3, 4.5]]))])
def test_columns_of_numbers_have_numeric_types(values, expected):
    found = column_of(values)
    assert found.dtype == expected.dtype and np.array_equal(found, expected, equal_nan=found.dtype == float)


@pytest.mark.parametrize("values", [[[1], [1, 2]], ["a", None], [["a"], ["b"]], [[], []], [None, None]])
def test_other_columns_hold_the_values_themselves(values):
    found = column_of(values)
    assert found.dtype == object and found.tolist() == values


def test_images_are_read_one_at_a_time_as_red_green_blue(tmp_path):
    with zencell.open_recording(write(tmp_path / "run.mcap", [image(n) for n in range(4)], every=1)) as run:
        found = list(run.images("camera/image_raw"))
        assert [stamp for stamp, _ in found] == [START + n for n in range(4)]
        assert [pixels[0, 0].tolist() for _, pixels in found] == [[n, 2, 1] for n in range(4)]
        assert next(run.images("camera/image_raw", encoded=True))[1][0, 0].tolist() == [1, 2, 0]
        assert "image" not in run.table("camera/image_raw").names
        assert run.table("camera/image_raw", images=True)["image"].shape == (4, 8, 8, 3)


def test_iterating_takes_constant_memory(tmp_path):
    side, count = 256, 40
    path = write(tmp_path / "run.mcap", [image(n, side) for n in range(count)], every=1)
    with zencell.open_recording(path) as run:
        run.table("camera/image_raw")  # what is imported at first use
        tracemalloc.start()
        seen = sum(len(table) for table in run.tables("camera/image_raw", size=2, images=True))
        seen += sum(1 for _ in run.images("camera/image_raw"))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert seen == 2 * count and peak < 15 * side * side * 3


def test_unknown_names_list_the_choices(tmp_path):
    with zencell.open_recording(write(tmp_path / "run.mcap", [joints(0)])) as run:
        with pytest.raises(zencell.UnknownName, match=r"unknown topic 'joint_state' \(did you mean 'joint_states'\?\)"):
            run.table("joint_state")
        with pytest.raises(zencell.UnknownName, match=r"unknown column 'a.pos'.*choices: .*a.position"):
            run.table("joint_states")["a.pos"]
        with pytest.raises(zencell.ConfigError, match="size: 0 must be 1 or more"):
            run.tables("joint_states", size=0)
    with pytest.raises(zencell.RecordingError, match="no such file"):
        zencell.open_recording(tmp_path / "other.mcap")
