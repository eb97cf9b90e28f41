"""What other programs get: Foxglove's schemas held, tables, pictures, a video."""

import base64
import csv
import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader

from applications.outlining.topics import OutlinePoints
from applications.pick_place.topics import PickPlaceStatus
from common import messages as m
from common.messages import Header, Image, Message, Pose, Quaternion, Vector3
from common.perception.image import array_to_image
from recording import export, foxglove
from recording.foxglove import convert
from recording.foxglove_scene import SCHEMAS
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
def test_messages_are_converted_to_foxglove_schemas(message: Message, schema: str) -> None:
    name, value = convert(message)
    assert name == schema
    value = json.loads(json.dumps(value, allow_nan=False))
    if schema in SCHEMAS:
        hold(value, SCHEMAS[schema])
    if "timestamp" in value:
        assert value["timestamp"] == TIME


def test_exported_image_has_the_recorded_pixels() -> None:
    for encoding in ("bgr8", "rgb8"):
        smooth = np.zeros((16, 16, 3), np.uint8)
        smooth[..., 0] = 200
        _, value = convert(array_to_image(smooth, encoding, HEADER))
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(value["data"]), np.uint8), cv2.IMREAD_COLOR)
        assert abs(int(pixels[8, 8, 0 if encoding == "bgr8" else 2]) - 200) < 5


def test_scene_replaces_the_one_before_and_attached_objects_move_with_their_link() -> None:
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


def foreign() -> Sample:
    return Sample("panda/mine", b"\x81\xa1a\x01", START, message="Somebodys", kind="event")


def test_foxglove_file_is_complete_and_skipped_messages_are_counted(tmp_path: Path) -> None:
    source = write(tmp_path / "a.mcap", [joints(0), joints(1), status(2), image(3, PICTURE), foreign()])
    decoder = Decoder()
    with Recording(source) as recording:
        count = foxglove.export_foxglove(recording, tmp_path / "f.mcap", lambda topic: True, decoder)
    assert (count, decoder.skipped) == (4, Counter({"mine": 1}))
    with (tmp_path / "f.mcap").open("rb") as file:
        found = [(s.name, c.topic, c.message_encoding, msg.log_time) for s, c, msg in make_reader(file).iter_messages()]
    assert found[0] == ("foxglove.JointStates", "panda/joint_states", "json", START)
    assert [name for name, *_ in found] == [
        "foxglove.JointStates", "foxglove.JointStates", "PickPlaceStatus", "foxglove.CompressedImage"]


def test_foxglove_file_that_does_not_fit_on_the_disk_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = write(tmp_path / "a.mcap", [joints(n) for n in range(100)])
    fill_disk(monkeypatch, 600)
    with Recording(source) as recording, pytest.raises(RecordingError, match=r"f.mcap: cannot be written, the disk is"):
        foxglove.export_foxglove(recording, tmp_path / "f.mcap", lambda topic: True, Decoder())
    assert list(tmp_path.iterdir()) == [source]


def custom_message(number: int) -> Sample:
    """A message whose class is not here, with the schema that was recorded."""
    values = {"header": {"stamp": START + number, "frame_id": "w"}, "gloss": number / 4, "raw": b"\xff\x00"}
    return Sample("panda/gloss", msgpack.packb(values), START + number * STEP, message="Gloss", writer="polisher.1",
                  sequence=number + 1, schema=json.dumps({"title": "Gloss", "type": "object"}).encode())


def test_messages_of_unknown_classes_are_exported_by_their_recorded_schema(tmp_path: Path) -> None:
    cut = write(tmp_path / "a.mcap", [custom_message(0), custom_message(1), foreign()])
    recover(cut, tmp_path / "b.mcap")
    decoder = Decoder()
    with Recording(tmp_path / "b.mcap") as recording:
        assert export.export_tables(recording, tmp_path / "csv", lambda topic: True, decoder) == {"gloss.csv": 2}
        assert foxglove.export_foxglove(recording, tmp_path / "f.mcap", lambda topic: True, decoder) == 2
    assert set(decoder.skipped) == {"mine"}
    assert [row["gloss"] for row in table(tmp_path / "csv" / "gloss.csv")] == ["0.0", "0.25"]
    with (tmp_path / "f.mcap").open("rb") as file:
        schema, _, message = next(iter(make_reader(file).iter_messages()))
    assert (schema.name, json.loads(schema.data)["title"]) == ("Gloss", "Gloss")
    assert base64.urlsafe_b64decode(json.loads(message.data)["raw"]) == b"\xff\x00"


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_tables_have_a_row_for_each_message_and_a_column_for_each_joint(tmp_path: Path) -> None:
    source = write(tmp_path / "a.mcap", [f(n) for n in range(5) for f in (joints, status)] + [image(9, PICTURE)])
    with Recording(source) as recording:
        counts = export.export_tables(recording, tmp_path / "csv", lambda topic: True, Decoder())
    assert counts == {"joint_states.csv": 5, "pick_place_status.csv": 5}
    rows = table(tmp_path / "csv" / "joint_states.csv")
    assert list(rows[0]) == ["time", "stamp", "a.position", "b.position", "a.velocity", "b.velocity"]
    assert rows[3]["time"] == "1700000000.030000000" and rows[3]["stamp"] == "1700000000.029000000"
    assert [float(row["a.position"]) for row in rows] == pytest.approx([0.1 * n for n in range(5)])
    states = table(tmp_path / "csv" / "pick_place_status.csv")
    assert [row["placed"] for row in states] == list("01234") and states[0]["plans"] == "[]"


def test_png_files_have_the_recorded_pixels(tmp_path: Path) -> None:
    depth = image(1, DEPTH, "32FC1", "panda/depth_camera/depth/image_raw")
    source = write(tmp_path / "a.mcap", [image(0, PICTURE), depth, image(2, PICTURE[..., ::-1].copy(), "rgb8")])
    with Recording(source) as recording:
        counts = export.export_images(recording, tmp_path / "png", lambda topic: True, Decoder())
    assert counts == {"camera/image_raw": 2, "depth_camera/depth/image_raw": 1}
    for path in sorted((tmp_path / "png" / "camera_image_raw").iterdir()):
        assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), PICTURE)
    (path,) = (tmp_path / "png" / "depth_camera_depth_image_raw").iterdir()
    assert path.name == f"000001_{depth.log_time - 5}.png"
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.full((6, 8), 1250, np.uint16))


def test_video_has_every_image_at_the_recorded_rate(tmp_path: Path) -> None:
    pixels = np.zeros((64, 80, 3), np.uint8)
    source = write(tmp_path / "a.mcap", [image(n, pixels + np.uint8(20 * n)) for n in range(10)])
    with Recording(source) as recording:
        count, rate = export.export_video(recording, tmp_path / "v.mp4", "camera/image_raw", Decoder())
    video = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert (count, rate) == (10, 10.0)
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (10, 10)
    frames = [video.read()[1] for _ in range(10)]
    assert abs(int(frames[9][32, 40, 1]) - 180) < 6
    video.release()


def test_video_that_does_not_fit_on_the_disk_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = write(tmp_path / "a.mcap", [image(n, PICTURE) for n in range(10)]), tmp_path / "v.mp4"
    open_writer = cv2.VideoWriter

    class Cut:
        """Writes to a disk that takes the first 40 bytes, of which OpenCV says nothing."""

        fourcc = open_writer.fourcc

        def __init__(self, *given: object) -> None:
            self.inner = open_writer(*given)  # type: ignore[call-overload]
            self.isOpened, self.write = self.inner.isOpened, self.inner.write

        def release(self) -> None:
            self.inner.release()
            os.truncate(target, 40)

    monkeypatch.setattr(export.cv2, "VideoWriter", Cut)
    with Recording(source) as recording, pytest.raises(RecordingError, match=r"v.mp4: cannot be written"):
        export.export_video(recording, target, "camera/image_raw", Decoder())
    assert list(tmp_path.iterdir()) == [source]


def test_video_of_a_depth_topic_is_rejected(tmp_path: Path) -> None:
    source = write(tmp_path / "a.mcap", [image(0, DEPTH, "32FC1")])
    with Recording(source) as recording, pytest.raises(RecordingError, match="has no color image"):
        export.export_video(recording, tmp_path / "v.mp4", "camera/image_raw", Decoder())


def test_field_that_a_class_no_longer_has_is_ignored() -> None:
    decoder = Decoder()
    values = {**msgpack.unpackb(joints(0).payload), "torque_of_old": 1}
    values["header"]["sequence_of_old"] = 7
    message = decoder.message(joints(0, payload=msgpack.packb(values)))
    assert message == decoder.message(joints(0)) and not decoder.skipped


def test_invalid_payload_is_counted_and_left_out() -> None:
    decoder = Decoder()
    assert decoder.message(joints(0)) is not None
    assert decoder.message(joints(0, payload=b"\xc1")) is None
    other = packed(Image(header=HEADER, height=1, width=1, encoding="x", data=b""))
    assert decoder.message(joints(0, payload=other)) is None
    assert decoder.skipped == {"joint_states": 2}
