"""JSON schemas of the Foxglove messages that exports and the bridge write."""

from __future__ import annotations

from typing import Any

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
                    triangles=_list(_object("foxglove.TriangleListPrimitive", pose=POSE, points=_list(POINT3),
                                            color=COLOR, colors=_list(COLOR), indices=_list(INTEGER))),
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
