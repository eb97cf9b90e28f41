"""Scenes as Foxglove's scene entities, and the JSON schemas of all exported messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from common.messages import (
    CollisionObject,
    Color,
    MarkerArray,
    PlanningScene,
    Pose,
    Vector3,
    WorldObject,
    WorldObjects,
)

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


Schema = dict[str, Any]

NUMBER: Schema = {"type": "number"}
INTEGER: Schema = {"type": "integer"}
TEXT: Schema = {"type": "string"}
FLAG: Schema = {"type": "boolean"}
BYTES: Schema = {"type": "string", "contentEncoding": "base64"}


def _object(title: str, **properties: Schema) -> Schema:
    return {"title": title, "type": "object", "properties": properties}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


def _time(title: str) -> Schema:
    return _object(title, sec={**INTEGER, "minimum": 0}, nsec={**INTEGER, "minimum": 0, "maximum": 999_999_999})


TIME = _time("time")
VECTOR3 = _object("foxglove.Vector3", x=NUMBER, y=NUMBER, z=NUMBER)
POINT3 = _object("foxglove.Point3", x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = _object("foxglove.Quaternion", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
POSE = _object("foxglove.Pose", position=VECTOR3, orientation=QUATERNION)
COLOR = _object("foxglove.Color", r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER)
_SHAPE = {"pose": POSE, "size": VECTOR3, "color": COLOR}

SCHEMAS: dict[str, Schema] = {
    schema["title"]: schema
    for schema in (
        _object("foxglove.CompressedImage", timestamp=TIME, frame_id=TEXT, data=BYTES, format=TEXT),
        _object("foxglove.RawImage", timestamp=TIME, frame_id=TEXT, width=INTEGER, height=INTEGER, encoding=TEXT,
                step=INTEGER, data=BYTES),
        _object("foxglove.CameraCalibration", timestamp=TIME, frame_id=TEXT, width=INTEGER, height=INTEGER,
                distortion_model=TEXT, D=_list(NUMBER), K=_list(NUMBER), R=_list(NUMBER), P=_list(NUMBER)),
        _object("foxglove.FrameTransforms", transforms=_list(_object(
            "foxglove.FrameTransform", timestamp=TIME, parent_frame_id=TEXT, child_frame_id=TEXT, translation=VECTOR3,
            rotation=QUATERNION))),
        _object("foxglove.PosesInFrame", timestamp=TIME, frame_id=TEXT, poses=_list(POSE)),
        _object("foxglove.JointStates", timestamp=TIME, joints=_list(_object(
            "foxglove.JointState", name=TEXT, position=NUMBER, velocity=NUMBER, effort=NUMBER))),
        _object("foxglove.Log", timestamp=TIME, level=INTEGER, message=TEXT, name=TEXT, file=TEXT, line=INTEGER),
        _object("foxglove.PointCloud", timestamp=TIME, frame_id=TEXT, pose=POSE, point_stride=INTEGER,
                fields=_list(_object("foxglove.PackedElementField", name=TEXT, offset=INTEGER, type=INTEGER)),
                data=BYTES),
        _object("foxglove.SceneUpdate",
                deletions=_list(_object("foxglove.SceneEntityDeletion", timestamp=TIME, type=INTEGER, id=TEXT)),
                entities=_list(_object(
                    "foxglove.SceneEntity", timestamp=TIME, frame_id=TEXT, id=TEXT, lifetime=_time("duration"),
                    frame_locked=FLAG, metadata=_list(_object("foxglove.KeyValuePair", key=TEXT, value=TEXT)),
                    arrows=_list(_object("foxglove.ArrowPrimitive")),
                    triangles=_list(_object("foxglove.TriangleListPrimitive")),
                    models=_list(_object("foxglove.ModelPrimitive")),
                    cubes=_list(_object("foxglove.CubePrimitive", **_SHAPE)),
                    spheres=_list(_object("foxglove.SpherePrimitive", **_SHAPE)),
                    cylinders=_list(_object("foxglove.CylinderPrimitive", **_SHAPE, bottom_scale=NUMBER,
                                            top_scale=NUMBER)),
                    lines=_list(_object("foxglove.LinePrimitive", type=INTEGER, pose=POSE, thickness=NUMBER,
                                        scale_invariant=FLAG, points=_list(POINT3), color=COLOR, colors=_list(COLOR),
                                        indices=_list(INTEGER))),
                    texts=_list(_object("foxglove.TextPrimitive", pose=POSE, billboard=FLAG, font_size=NUMBER,
                                        scale_invariant=FLAG, color=COLOR, text=TEXT))))),
    )
}
