"""Exports recordings for Foxglove: MCAP with JSON messages of Foxglove's schemas where there is one for a message.

An application adds its own messages by its attribute `foxglove`, a list like KINDS.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Sequence
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
    CollisionObject,
    Color,
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
    Vector3,
    WorldObject,
    WorldObjects,
)
from common.perception.image import image_to_array
from recording.foxglove_schemas import SCHEMAS
from recording.reader import Recording, Wanted
from recording.sample import Decoder, schema_of
from recording.writer import AppendedFile, ExportFailed, WriteFailed

LINE_LOOP = 1
DELETE_ALL = 1
PRIMITIVES = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")  # all required
THICKNESS = 0.004  # of lines [m]

Entity = dict[str, Any]


def time_of(stamp: int) -> dict[str, int]:
    """Return a stamp [ns] as a Foxglove time."""
    return {"sec": stamp // 1_000_000_000, "nsec": stamp % 1_000_000_000}


def update(stamp: int, entities: list[Entity]) -> dict[str, Any]:
    """Return a scene that replaces the one before on its topic."""
    return {
        "deletions": [{"timestamp": time_of(stamp), "type": DELETE_ALL, "id": ""}],
        "entities": entities,
    }


def entity(name: str, frame: str, stamp: int, **primitives: list[dict[str, Any]]) -> Entity:
    """Return an entity that stays until it is replaced or deleted."""
    return {
        "timestamp": time_of(stamp), "frame_id": frame, "id": name, "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True, "metadata": [], **{key: [] for key in PRIMITIVES}, **primitives,
    }


def of_markers(message: MarkerArray) -> dict[str, Any]:
    """Convert markers."""
    stamp, frame = message.header.stamp, message.header.frame_id
    entities = []
    for marker in message.markers:
        shape = _shape(marker.type, marker.pose, marker.scale, marker.color, marker.text)
        entities.append(entity(f"{marker.ns}_{marker.id}", frame, stamp, **shape))
    return update(stamp, entities)


def of_scene(message: PlanningScene) -> dict[str, Any]:
    """Convert the objects of a planning scene; attached ones move with their link."""
    stamp = message.header.stamp
    entities = [entity(solid.id, message.header.frame_id, stamp, **_solid(solid)) for solid in message.objects]
    for held in message.attached:
        entities.append(entity(held.object.id, held.link, stamp, **_solid(held.object)))
    return update(stamp, entities)


def of_world(message: WorldObjects) -> dict[str, Any]:
    """Convert the solids of the simulated world; upright prisms become the edges of their top and base."""
    stamp = message.header.stamp
    return update(stamp, [entity(solid.id, "world", stamp, **_of_object(solid)) for solid in message.objects])


def _shape(kind: str, pose: Pose, size: Vector3, color: Color, text: str) -> dict[str, list[dict[str, Any]]]:
    shape = {"pose": pose.model_dump(), "size": size.model_dump(), "color": color.model_dump()}
    if kind == "box":
        return {"cubes": [shape]}
    if kind == "sphere":
        return {"spheres": [shape]}
    if kind == "cylinder":
        return {"cylinders": [{**shape, "bottom_scale": 1.0, "top_scale": 1.0}]}
    return {"texts": [{
        "pose": shape["pose"], "billboard": True, "font_size": size.z, "scale_invariant": False,
        "color": shape["color"], "text": text,
    }]}


def _solid(solid: CollisionObject) -> dict[str, list[dict[str, Any]]]:
    d = solid.dimensions
    if solid.shape == "box":
        return _shape("box", solid.pose, Vector3(x=d[0], y=d[1], z=d[2]), solid.color, "")
    if solid.shape == "sphere":
        return _shape("sphere", solid.pose, Vector3(x=2 * d[0], y=2 * d[0], z=2 * d[0]), solid.color, "")
    if solid.shape == "cylinder":
        return _shape("cylinder", solid.pose, Vector3(x=2 * d[0], y=2 * d[0], z=d[1]), solid.color, "")
    edges = [closed_line([(x, y, z) for x, y in solid.outline], solid.color) for z in (-d[0] / 2, d[0] / 2)]
    return {"lines": [{**edge, "pose": solid.pose.model_dump()} for edge in edges]}


def _of_object(solid: WorldObject) -> dict[str, list[dict[str, Any]]]:
    if solid.outline:
        return {"lines": _edges(solid)}
    if solid.shape in ("sphere", "box", "cylinder"):
        return _shape(solid.shape, solid.pose, solid.size, solid.color, "")
    if solid.shape == "mesh":
        return {"triangles": [{
            "pose": solid.pose.model_dump(), "color": solid.color.model_dump(), "colors": [],
            "points": [{"x": x, "y": y, "z": z} for x, y, z in solid.vertices],
            "indices": [corner for triangle in solid.triangles for corner in triangle],
        }]}
    edges = [closed_line([(x, y, z) for x, y in loop], solid.color)
             for loop in _sections(solid) for z in (-solid.size.z / 2, solid.size.z / 2)]
    return {"lines": [{**edge, "pose": solid.pose.model_dump()} for edge in edges]}


def _sections(solid: WorldObject) -> list[list[tuple[float, float]]]:
    """Return the outlines of the cross-section of a prism or ring, in its own frame [m]."""
    if solid.shape == "prism":
        return [solid.polygon]
    turns = [2 * math.pi * k / 36 for k in range(36)]
    return [[(r * math.cos(a), r * math.sin(a)) for a in turns] for r in (solid.size.x / 2, solid.inner_radius)]


def _edges(solid: WorldObject) -> list[dict[str, Any]]:
    loops = [solid.outline, *([solid.hole] if solid.hole else [])]
    heights = (solid.base, solid.base + solid.height)
    return [closed_line([(x, y, z) for x, y in loop], solid.color) for loop in loops for z in heights]


def closed_line(points: Sequence[tuple[float, float, float]], color: Color) -> dict[str, Any]:
    """Return a closed line through points [m]."""
    return {
        "type": LINE_LOOP, "pose": Pose().model_dump(), "thickness": THICKNESS, "scale_invariant": False,
        "points": [{"x": x, "y": y, "z": z} for x, y, z in points], "color": color.model_dump(),
        "colors": [], "indices": [],
    }


JPEG_QUALITY = 90
LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "critical": 5}
FLOAT32, UINT8 = 7, 1
CONVERSION_ERRORS = (ZencellError, ArithmeticError, ValueError, LookupError, TypeError, cv2.error)
CHUNK_BYTES = 1024 * 1024

# Not the package foxglove-sdk 0.30: it sets neither publish time nor sequence number of a message, needs the same
# conversions (it saves only the schemas below), and has 54 MB.


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
            decoder.unfit[sample.topic] += 1
            continue
        if name not in schemas:
            schemas[name] = writer.register_schema(name, "jsonschema", schema_text(name, sample.schema))
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


def schema_name(model: type[Message]) -> str:
    """Return the name of the schema to which `convert` converts messages of a class, except images."""
    return next((name for kind, name, _ in _kinds() if issubclass(model, kind)), model.__name__)


def schema_text(name: str, recorded: bytes = b"") -> bytes:
    """Return a JSON schema as UTF-8: that of Foxglove, else the recorded one, else that of the message class."""
    return json.dumps(SCHEMAS[name]).encode() if name in SCHEMAS else recorded or schema_of(name)


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
