"""Exports for other programs: Foxglove files, tables, images and a video."""

import base64
import csv
import json
import os
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader

from applications.outlining.topics import OutlinePoints
from applications.pick_place.topics import PickPlaceStatus
from cli.main import app
from common import messages as m
from common.messages import Header, Image, Message, Pose, Quaternion, Vector3
from common.perception.image import array_to_image
from recording import export, foxglove
from recording.foxglove import convert
from recording.foxglove_schemas import SCHEMAS
from recording.reader import Recording, recover
from recording.sample import Decoder, RecordingError, Sample
from tests.recording.samples import START, STEP, fill_disk, joints, packed, status, write

HEADER = Header(stamp=1_700_000_000_123_456_789, frame_id="world")
TIME = {"sec": 1_700_000_000, "nsec": 123_456_789}
POSE = Pose(position=Vector3(x=1, y=2, z=3), orientation=Quaternion(x=1, y=0, z=0, w=0))
RED = m.Color(r=1, g=0, b=0, a=0.5)
PICTURE = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
DEPTH = np.full((6, 8), 1.25, np.float32)
SOLID = m.CollisionObject(id="box", role="fixture", shape="box", dimensions=[1, 2, 3], pose=POSE, color=RED)
ROUND = m.CollisionObject(id="ball", role="attached", shape="sphere", dimensions=[0.03], pose=POSE)
HELD = m.AttachedObject(link="hand", object=ROUND)
CAN = m.CollisionObject(id="can", role="target", shape="cylinder", dimensions=[0.1, 0.4], pose=POSE)
PRISM = m.CollisionObject(
    id="wedge", role="target", shape="prism", dimensions=[0.2], outline=[(0, 0), (1, 0), (0, 1)], pose=POSE)

CONVERTED: list[tuple[Message, str]] = [
    (array_to_image(PICTURE, "bgr8", HEADER), "foxglove.CompressedImage"),
    (array_to_image(PICTURE, "rgb8", HEADER), "foxglove.CompressedImage"),
    (array_to_image(DEPTH, "32FC1", HEADER), "foxglove.RawImage"),
    (m.CameraInfo(header=HEADER, height=6, width=8, k=[5, 0, 4, 0, 5, 3, 0, 0, 1]), "foxglove.CameraCalibration"),
    (m.TFMessage(transforms=[m.TransformStamped(header=HEADER, child_frame_id="a", transform=POSE)]),
     "foxglove.FrameTransforms"),
    (m.PoseArray(header=HEADER, poses=[POSE]), "foxglove.PosesInFrame"),
    (OutlinePoints(header=HEADER, poses=[POSE, POSE], object="Object_0"), "foxglove.SceneUpdate"),
    (OutlinePoints(header=HEADER), "foxglove.SceneUpdate"),
    (m.MarkerArray(header=HEADER, markers=[
        m.Marker(ns="n", id=i, type=kind, pose=POSE, scale=Vector3(x=1, y=1, z=1), text="t")
        for i, kind in enumerate(["sphere", "cylinder", "box", "text"])]), "foxglove.SceneUpdate"),
    (m.PlanningScene(header=HEADER, objects=[SOLID, CAN, PRISM], attached=[HELD]), "foxglove.SceneUpdate"),
    (m.WorldObjects(header=HEADER, objects=[m.WorldObject(
        id="r", shape="ring", outline=[(0, 0), (1, 0), (0, 1)], hole=[(0.1, 0.1), (0.2, 0.1), (0.1, 0.2)], base=0.0,
        height=0.1)]), "foxglove.SceneUpdate"),
    (m.JointState(header=HEADER, name=["a"], position=[1.0], velocity=[2.0]), "foxglove.JointStates"),
    (m.LogLine(header=HEADER, service="s", level="warning", message="hot"), "foxglove.Log"),
    (m.PointCloud2(header=HEADER, height=1, width=1, row_step=16, data=bytes(16)), "foxglove.PointCloud"),
    (PickPlaceStatus(header=HEADER, state="DONE"), "PickPlaceStatus"),
]
TYPES = {"number": (int, float), "integer": int, "string": str, "boolean": bool, "array": list, "object": dict}


def hold(value: Any, schema: dict[str, Any], path: str = "") -> None:
    """The value has the fields and types of a schema, and no others."""
    assert isinstance(value, TYPES[schema["type"]]), path
    if schema["type"] == "object":
        assert value.keys() <= schema["properties"].keys(), path
        for name, item in value.items():
            hold(item, schema["properties"][name], f"{path}.{name}")
    if schema["type"] == "array":
        for item in value:
            hold(item, schema["items"], f"{path}[]")


@pytest.mark.parametrize(("message", "schema"), CONVERTED, ids=[f"{type(c).__name__}-{n}" for c, n in CONVERTED])
def test_messages_are_converted_to_foxglove_schemas(message, schema):
    name, value = convert(message)
    assert name == schema
    value = json.loads(json.dumps(value, allow_nan=False))
    if schema in SCHEMAS:
        hold(value, SCHEMAS[schema])
    if "timestamp" in value:
        assert value["timestamp"] == TIME


@pytest.mark.parametrize(("encoding", "blue"), [("bgr8", 0), ("rgb8", 2)])
def test_exported_image_has_the_recorded_pixels(encoding, blue):
    smooth = np.zeros((16, 16, 3), np.uint8)
    smooth[..., 0] = 200
    _, value = convert(array_to_image(smooth, encoding, HEADER))
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(value["data"]), np.uint8), cv2.IMREAD_COLOR)
    assert abs(int(pixels[8, 8, blue]) - 200) < 5


def test_scene_replaces_the_one_before_and_attached_objects_move_with_their_link():
    _, value = convert(next(message for message, _ in CONVERTED if isinstance(message, m.PlanningScene)))
    assert value["deletions"] == [{"timestamp": TIME, "type": 1, "id": ""}]
    frames = {entity["id"]: entity["frame_id"] for entity in value["entities"]}
    assert frames == {"box": "world", "can": "world", "wedge": "world", "ball": "hand"}
    assert value["entities"][0]["cubes"][0]["size"] == {"x": 1, "y": 2, "z": 3}
    assert value["entities"][3]["spheres"][0]["size"] == {"x": 0.06, "y": 0.06, "z": 0.06}


def image(number: int, pixels: np.ndarray, encoding: str = "bgr8", key: str = "panda/camera/image_raw") -> Sample:
    log_time = START + number * 10 * STEP
    message = array_to_image(pixels, encoding, Header(stamp=log_time - 5, frame_id="camera"))
    return Sample(key, packed(message), log_time, message="Image", writer="camera.1", sequence=number + 1)


def custom(number: int) -> Sample:
    """Return a message of an unknown class, with its recorded schema."""
    values = {"header": {"stamp": START + number, "frame_id": "w"}, "gloss": number / 4, "raw": b"\xff\x00"}
    return Sample("panda/gloss", msgpack.packb(values), START + number * STEP, message="Gloss", writer="polisher.1",
                  sequence=number + 1, schema=json.dumps({"title": "Gloss", "type": "object"}).encode())


FOREIGN = Sample("panda/mine", b"\x81\xa1a\x01", START, message="Foreign", kind="event")


@pytest.fixture
def recorded(tmp_path):
    with ExitStack() as stack:
        yield lambda *samples: stack.enter_context(Recording(write(tmp_path / "a.mcap", list(samples))))


def every(topic: str) -> bool:
    return True


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def messages_of(path: Path) -> list[tuple[Any, Any, Any]]:
    with path.open("rb") as file:
        return list(make_reader(file).iter_messages())


def test_foxglove_file_is_complete_and_skipped_messages_are_counted(tmp_path, recorded):
    recording, decoder = recorded(joints(0), joints(1), status(2), image(3, PICTURE), FOREIGN), Decoder()
    assert foxglove.export_foxglove(recording, tmp_path / "f.mcap", every, decoder) == 4
    assert decoder.skipped == Counter({"mine": 1})
    found = [(s.name, c.topic, c.message_encoding, m.log_time) for s, c, m in messages_of(tmp_path / "f.mcap")]
    assert found[0] == ("foxglove.JointStates", "panda/joint_states", "json", START)
    assert [name for name, *_ in found] == [
        "foxglove.JointStates", "foxglove.JointStates", "PickPlaceStatus", "foxglove.CompressedImage"]


def test_export_counts_what_it_leaves_out(tmp_path, capsys):
    strange = joints(9, key="panda/mine", message="Mine", payload=b"\xc1")
    path = write(tmp_path / "a.mcap", [joints(0), *(image(n, PICTURE) for n in range(3)), strange, strange])
    assert app.execute(["export", str(path), "--csv", str(tmp_path / "csv"), "--images", str(tmp_path / "png")]) == 0
    shown = capsys.readouterr()
    assert sorted(shown.err.splitlines()) == [
        "camera/image_raw: 3 messages left out: --csv cannot hold them",
        "mine: 2 messages left out: this version does not know their type"]
    assert "joint_states.csv: 1 rows" in shown.out and "image_raw: 3 images" in shown.out


def test_messages_of_unknown_classes_are_exported_by_their_recorded_schema(tmp_path):
    recover(write(tmp_path / "a.mcap", [custom(0), custom(1), FOREIGN]), tmp_path / "b.mcap")
    decoder = Decoder()
    with Recording(tmp_path / "b.mcap") as recording:
        assert export.export_tables(recording, tmp_path / "csv", every, decoder) == {"gloss.csv": 2}
        assert foxglove.export_foxglove(recording, tmp_path / "f.mcap", every, decoder) == 2
    assert set(decoder.skipped) == {"mine"}
    assert [row["gloss"] for row in table(tmp_path / "csv" / "gloss.csv")] == ["0.0", "0.25"]
    schema, _, message = messages_of(tmp_path / "f.mcap")[0]
    assert (schema.name, json.loads(schema.data)["title"]) == ("Gloss", "Gloss")
    assert base64.urlsafe_b64decode(json.loads(message.data)["raw"]) == b"\xff\x00"


def test_tables_have_a_row_for_each_message_and_a_column_for_each_joint(tmp_path, recorded):
    recording = recorded(*(f(n) for n in range(5) for f in (joints, status)), image(9, PICTURE))
    counts = export.export_tables(recording, tmp_path / "csv", every, Decoder())
    assert counts == {"joint_states.csv": 5, "pick_place_status.csv": 5}
    rows = table(tmp_path / "csv" / "joint_states.csv")
    assert list(rows[0]) == ["time", "stamp", "a.position", "b.position", "a.velocity", "b.velocity"]
    assert rows[3]["time"] == "1700000000.030000000" and rows[3]["stamp"] == "1700000000.029000000"
    assert [float(row["a.position"]) for row in rows] == pytest.approx([0.1 * n for n in range(5)])
    states = table(tmp_path / "csv" / "pick_place_status.csv")
    assert [row["placed"] for row in states] == list("01234") and states[0]["plans"] == "[]"


def test_png_files_have_the_recorded_pixels(tmp_path, recorded):
    depth = image(1, DEPTH, "32FC1", "panda/depth_camera/depth/image_raw")
    recording = recorded(image(0, PICTURE), depth, image(2, PICTURE[..., ::-1].copy(), "rgb8"))
    counts = export.export_images(recording, tmp_path / "png", every, Decoder())
    assert counts == {"camera/image_raw": 2, "depth_camera/depth/image_raw": 1}
    for path in sorted((tmp_path / "png" / "camera_image_raw").iterdir()):
        assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), PICTURE)
    (path,) = (tmp_path / "png" / "depth_camera_depth_image_raw").iterdir()
    assert path.name == f"000001_{depth.log_time - 5}.png"
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.full((6, 8), 1250, np.uint16))


def test_video_has_every_image_at_the_recorded_rate(tmp_path, recorded):
    pixels = np.zeros((64, 80, 3), np.uint8)
    recording = recorded(*(image(n, pixels + np.uint8(20 * n)) for n in range(10)))
    assert export.export_video(recording, tmp_path / "v.mp4", "camera/image_raw", Decoder()) == (10, 10.0)
    video = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (10, 10)
    frames = [video.read()[1] for _ in range(10)]
    assert abs(int(frames[9][32, 40, 1]) - 180) < 6
    video.release()


def test_file_that_does_not_fit_on_the_disk_is_removed(tmp_path, monkeypatch, recorded):
    recording = recorded(*(image(n, PICTURE) for n in range(10)))
    open_writer, target = cv2.VideoWriter, tmp_path / "v.mp4"

    class Truncated:
        """Write to a disk that takes the first 40 bytes, which OpenCV does not report."""

        fourcc = open_writer.fourcc

        def __init__(self, *given: object) -> None:
            self.inner = open_writer(*given)
            self.isOpened, self.write = self.inner.isOpened, self.inner.write

        def release(self) -> None:
            self.inner.release()
            os.truncate(target, 40)

    monkeypatch.setattr(export.cv2, "VideoWriter", Truncated)
    with pytest.raises(RecordingError, match=r"v.mp4: cannot be written"):
        export.export_video(recording, target, "camera/image_raw", Decoder())
    fill_disk(monkeypatch, 600)
    with pytest.raises(RecordingError, match=r"f.mcap: cannot be written, the disk is"):
        foxglove.export_foxglove(recording, tmp_path / "f.mcap", every, Decoder())
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_video_of_a_depth_topic_is_rejected(tmp_path, recorded):
    with pytest.raises(RecordingError, match="has no color image"):
        export.export_video(
            recorded(image(0, DEPTH, "32FC1")), tmp_path / "v.mp4", "camera/image_raw", Decoder())


def test_removed_field_is_ignored_and_an_invalid_payload_is_counted():
    decoder = Decoder()
    values = {**msgpack.unpackb(joints(0).payload), "torque_of_old": 1}
    values["header"]["sequence_of_old"] = 7
    message = decoder.message(joints(0, payload=msgpack.packb(values)))
    assert message is not None and message == decoder.message(joints(0)) and not decoder.skipped
    assert decoder.message(joints(0, payload=b"\xc1")) is None
    other = packed(Image(header=HEADER, height=1, width=1, encoding="x", data=b""))
    assert decoder.message(joints(0, payload=other)) is None
    assert decoder.skipped == {"joint_states": 2}
