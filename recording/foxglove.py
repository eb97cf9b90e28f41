"""Exports recordings for Foxglove: MCAP with JSON messages of Foxglove's schemas where there is one for a message.

An application adds its own messages by its attribute `foxglove`, a list like KINDS.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from common.application import applications
from common.errors import ZencellError
from common.messages import (
    CameraInfo,
    Image,
    JointState,
    LogLine,
    MarkerArray,
    Message,
    PlanningScene,
    PointCloud2,
    Pose,
    PoseArray,
    TFMessage,
    WorldObjects,
)
from common.perception.image import image_to_array
from recording.foxglove_scene import SCHEMAS, of_markers, of_scene, of_world, time_of
from recording.reader import Recording, Wanted
from recording.sample import Decoder, schema_of
from recording.writer import AppendedFile, ExportFailed, WriteFailed

JPEG_QUALITY = 90
LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "critical": 5}
FLOAT32, UINT8 = 7, 1
CONVERSION_ERRORS = (ZencellError, ArithmeticError, ValueError, LookupError, TypeError, cv2.error)
CHUNK_BYTES = 1024 * 1024

# Not the package foxglove-sdk 0.30: it sets neither publish time nor sequence number of a message, needs the same
# conversions (it saves only the schemas in foxglove_scene.py), and has 54 MB.


def export_foxglove(recording: Recording, target: Path, wants: Wanted, decoder: Decoder) -> int:
    """Write a new file and return the number of messages; on failure the file is removed.

    Color images become JPEG. A message without a Foxglove schema is written as JSON of its own schema.

    Raises:
        RecordingError: the target exists already or cannot be written, or the recording is damaged.
    """
    file = AppendedFile(target)
    try:
        return _write(recording, file, wants, decoder)
    except BaseException as error:
        target.unlink(missing_ok=True)
        if isinstance(error, WriteFailed):
            raise ExportFailed(target, error.why) from None
        raise
    finally:
        file.close()


def _write(recording: Recording, file: AppendedFile, wants: Wanted, decoder: Decoder) -> int:
    count = 0
    writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
    writer.start()
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for sample in recording.samples(wants):
        message = decoder.message(sample)
        if message is None:
            continue
        try:
            name, value = convert(message)
        except CONVERSION_ERRORS:
            decoder.skipped[sample.topic] += 1
            continue
        if name not in schemas:
            text = json.dumps(SCHEMAS[name]).encode() if name in SCHEMAS else sample.schema or schema_of(name)
            schemas[name] = writer.register_schema(name, "jsonschema", text)
        if sample.key not in channels:
            channels[sample.key] = writer.register_channel(sample.key, "json", schemas[name])
        data = json.dumps(value, separators=(",", ":")).encode()
        writer.add_message(channels[sample.key], sample.log_time, data, sample.publish_time, sample.sequence)
        count += 1
    writer.finish()  # type: ignore[no-untyped-call]
    return count


def convert(message: Message) -> tuple[str, dict[str, Any]]:
    """Return the name of the Foxglove schema, and the message as a JSON object of that schema."""
    if isinstance(message, Image):
        return image(message)
    for kind, name, to_json in _kinds():
        if isinstance(message, kind):
            return name, to_json(message)
    return type(message).__name__, message.model_dump(mode="json")


@cache
def _kinds() -> list[Kind]:
    """Return the conversions, those of applications first: their messages derive from the platform's."""
    custom = [kind for found in applications() for kind in found.foxglove or ()]
    return [*custom, *KINDS]


def image(message: Image) -> tuple[str, dict[str, Any]]:
    """Convert an image: color to JPEG, depth unchanged."""
    header = {"timestamp": time_of(message.header.stamp), "frame_id": message.header.frame_id}
    if message.encoding not in ("bgr8", "rgb8", "mono8"):
        return "foxglove.RawImage", {
            **header, "width": message.width, "height": message.height, "encoding": message.encoding,
            "step": message.step or len(message.data) // message.height, "data": _base64(message.data),
        }
    pixels = image_to_array(message)
    if message.encoding == "rgb8":
        pixels = np.ascontiguousarray(pixels[:, :, ::-1])
    _, packed = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "foxglove.CompressedImage", {**header, "data": _base64(packed.tobytes()), "format": "jpeg"}


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _calibration(message: CameraInfo) -> dict[str, Any]:
    k = message.k
    return {
        "timestamp": time_of(message.header.stamp), "frame_id": message.header.frame_id, "width": message.width,
        "height": message.height, "distortion_model": message.distortion_model, "D": message.d, "K": k,
        "R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "P": [*k[0:3], 0, *k[3:6], 0, *k[6:9], 0],
    }


def _transforms(message: TFMessage) -> dict[str, Any]:
    return {"transforms": [
        {
            "timestamp": time_of(t.header.stamp), "parent_frame_id": t.header.frame_id,
            "child_frame_id": t.child_frame_id, "translation": t.transform.position.model_dump(),
            "rotation": t.transform.orientation.model_dump(),
        }
        for t in message.transforms
    ]}


def _poses(message: PoseArray) -> dict[str, Any]:
    return {
        "timestamp": time_of(message.header.stamp), "frame_id": message.header.frame_id,
        "poses": [pose.model_dump() for pose in message.poses],
    }


def _joints(message: JointState) -> dict[str, Any]:
    columns = {"position": message.position, "velocity": message.velocity, "effort": message.effort}
    return {"timestamp": time_of(message.header.stamp), "joints": [
        {"name": name, **{field: values[i] for field, values in columns.items() if values}}
        for i, name in enumerate(message.name)
    ]}


def _log(message: LogLine) -> dict[str, Any]:
    return {
        "timestamp": time_of(message.header.stamp), "level": LEVELS[message.level], "message": message.message,
        "name": message.service, "file": "", "line": 0,
    }


def _cloud(message: PointCloud2) -> dict[str, Any]:
    # The packed color is 0x00RRGGBB, little-endian: blue comes first.
    fields = [(name, 4 * i, FLOAT32) for i, name in enumerate("xyz")]
    fields += [(name, 12 + i, UINT8) for i, name in enumerate(("blue", "green", "red"))]
    return {
        "timestamp": time_of(message.header.stamp), "frame_id": message.header.frame_id, "pose": Pose().model_dump(),
        "point_stride": message.point_step, "data": _base64(message.data),
        "fields": [{"name": name, "offset": offset, "type": kind} for name, offset, kind in fields],
    }


Kind = tuple[type[Message], str, Callable[[Any], dict[str, Any]]]  # message, schema, conversion
KINDS: list[Kind] = [
    (CameraInfo, "foxglove.CameraCalibration", _calibration),
    (TFMessage, "foxglove.FrameTransforms", _transforms),
    (PoseArray, "foxglove.PosesInFrame", _poses),
    (MarkerArray, "foxglove.SceneUpdate", of_markers),
    (PlanningScene, "foxglove.SceneUpdate", of_scene),
    (WorldObjects, "foxglove.SceneUpdate", of_world),
    (JointState, "foxglove.JointStates", _joints),
    (LogLine, "foxglove.Log", _log),
    (PointCloud2, "foxglove.PointCloud", _cloud),
]
