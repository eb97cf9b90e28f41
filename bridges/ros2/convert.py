"""Messages of a cell as messages of ROS 2."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bridges.ros2.types import make
from common import messages as m

MARKER = "visualization_msgs/msg/Marker"
ADD, DELETE_ALL = 0, 3
CUBE, SPHERE, CYLINDER, LINE_LIST, TEXT, TRIANGLE_LIST = 1, 2, 3, 5, 9, 11
THICKNESS = 0.002  # of lines [m]
OK, WARN, ERROR, STALE = 0, 1, 2, 3  # levels of diagnostics
FLOAT32 = 7  # of a PointField


def time_of(stamp: int) -> Any:
    """Return a stamp [ns] as a time."""
    return make("builtin_interfaces/msg/Time", sec=stamp // 1_000_000_000, nanosec=stamp % 1_000_000_000)


def duration_of(seconds: float) -> Any:
    """Return a duration [s]."""
    whole = round(seconds * 1e9)
    return make("builtin_interfaces/msg/Duration", sec=whole // 1_000_000_000, nanosec=whole % 1_000_000_000)


def header_of(header: m.Header) -> Any:
    """Return a header."""
    return make("std_msgs/msg/Header", stamp=time_of(header.stamp), frame_id=header.frame_id)


def uuid_of(data: bytes) -> Any:
    """Return an id of 16 bytes."""
    return make("unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(data, np.uint8))


def text(data: str) -> Any:
    """Return a std_msgs/String."""
    return make("std_msgs/msg/String", data=data)


def joints(message: m.JointState) -> Any:
    """Convert joint states."""
    return make("sensor_msgs/msg/JointState", header=header_of(message.header), name=message.name,
                position=np.array(message.position), velocity=np.array(message.velocity, float),
                effort=np.array(message.effort, float))


def transforms(message: m.TFMessage) -> Any:
    """Convert transforms."""
    return make("tf2_msgs/msg/TFMessage", transforms=[
        make("geometry_msgs/msg/TransformStamped", header=header_of(each.header), child_frame_id=each.child_frame_id,
             transform=make("geometry_msgs/msg/Transform", translation=_vector(each.transform.position),
                            rotation=_quaternion(each.transform.orientation)))
        for each in message.transforms])


def image(message: m.Image) -> Any:
    """Convert an image; its pixels are not copied."""
    return make("sensor_msgs/msg/Image", header=header_of(message.header), height=message.height, width=message.width,
                encoding=message.encoding, is_bigendian=int(message.is_bigendian),
                step=message.step or len(message.data) // message.height,
                data=np.frombuffer(message.data, np.uint8))


def calibration(message: m.CameraInfo) -> Any:
    """Convert a calibration."""
    k = np.array(message.k, float)
    p = np.hstack((k.reshape(3, 3), np.zeros((3, 1)))).ravel()
    return make("sensor_msgs/msg/CameraInfo", header=header_of(message.header), height=message.height,
                width=message.width, distortion_model=message.distortion_model, d=np.array(message.d, float), k=k,
                r=np.eye(3).ravel(), p=p)


def cloud(message: m.PointCloud2) -> Any:
    """Convert a point cloud."""
    fields = [make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=FLOAT32, count=1)
              for i, name in enumerate(message.fields)]
    return make("sensor_msgs/msg/PointCloud2", header=header_of(message.header), height=message.height,
                width=message.width, fields=fields, point_step=message.point_step, row_step=message.row_step,
                data=np.frombuffer(message.data, np.uint8))


def poses(message: m.PoseArray) -> Any:
    """Convert poses."""
    return make("geometry_msgs/msg/PoseArray", header=header_of(message.header),
                poses=[_pose(pose) for pose in message.poses])


def trajectory(message: m.JointTrajectory) -> Any:
    """Convert a trajectory."""
    return make("trajectory_msgs/msg/JointTrajectory", header=header_of(message.header),
                joint_names=message.joint_names, points=[
                    make("trajectory_msgs/msg/JointTrajectoryPoint", positions=np.array(point.positions, float),
                         velocities=np.array(point.velocities, float),
                         accelerations=np.array(point.accelerations, float),
                         time_from_start=duration_of(point.time_from_start))
                    for point in message.points])


def markers(message: m.MarkerArray) -> Any:
    """Convert markers; they replace those before."""
    kinds = {"box": CUBE, "sphere": SPHERE, "cylinder": CYLINDER, "text": TEXT}
    return _array(message.header, [
        _marker(message.header, each.ns, each.id, kinds[each.type], each.pose, each.color, scale=_vector(each.scale),
                text=each.text)
        for each in message.markers])


def scene(message: m.PlanningScene) -> Any:
    """Convert a planning scene to markers; attached solids move with their link."""
    found = [_solid(message.header, number, solid) for number, solid in enumerate(message.objects)]
    for number, held in enumerate(message.attached):
        at_link = m.Header(stamp=message.header.stamp, frame_id=held.link)
        found.append(_solid(at_link, len(message.objects) + number, held.object))
    return _array(message.header, found)


def world(message: m.WorldObjects) -> Any:
    """Convert the simulated world to markers."""
    header = m.Header(stamp=message.header.stamp, frame_id="world")
    return _array(header, [_world_object(header, number, each) for number, each in enumerate(message.objects)])


def motion(message: m.MotionStatus) -> Any:
    """Convert the state of the motion to a diagnostic status."""
    blocked = message.held or bool(message.stopped) or bool(message.fault)
    level = ERROR if message.state in ("aborted", "rejected") else WARN if blocked else OK
    return _status("motion", level, message.message or message.state, message)


def robot(message: m.RobotStatus) -> Any:
    """Convert the state of the arm's controller to a diagnostic status."""
    return _status("robot", WARN if message.message else OK, message.message or message.mode, message)


def task(message: m.TaskStatus) -> Any:
    """Convert the status of a task to a diagnostic status."""
    return _status("task", ERROR if message.state == "ERROR" else OK, message.state, message)


def processes(message: m.SupervisorStatus) -> Any:
    """Convert the state of all processes to diagnostics."""
    levels = {"ready": OK, "failed": ERROR, "stopped": STALE}
    return make("diagnostic_msgs/msg/DiagnosticArray", header=header_of(message.header), status=[
        make("diagnostic_msgs/msg/DiagnosticStatus", level=levels.get(each.state, WARN),
             name=f"{message.cell}: {each.name}", message=each.message or each.state, hardware_id=each.host,
             values=_values({"state": each.state, "pid": each.pid, "restarts": each.restarts}))
        for each in message.services])


def _status(name: str, level: int, summary: str, message: m.Message) -> Any:
    fields = message.model_dump(mode="json", exclude={"header"})
    return make("diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=summary, values=_values(fields))


def _values(fields: dict[str, Any]) -> list[Any]:
    return [make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in fields.items()]


def _array(header: m.Header, found: Sequence[Any]) -> Any:
    clear = make(MARKER, header=header_of(header), action=DELETE_ALL)
    return make("visualization_msgs/msg/MarkerArray", markers=[clear, *found])


def _marker(header: m.Header, ns: str, number: int, kind: int, pose: m.Pose, color: m.Color, **fields: Any) -> Any:
    return make(MARKER, header=header_of(header), ns=ns, id=number, type=kind, action=ADD, pose=_pose(pose),
                color=_color(color), frame_locked=True, **fields)


def _solid(header: m.Header, number: int, solid: m.CollisionObject) -> Any:
    d = solid.dimensions
    if solid.shape == "prism":
        return _edges(header, solid.id, number, solid.pose, solid.color, [solid.outline], d[0])
    kind, size = {"box": (CUBE, d), "sphere": (SPHERE, [2 * d[0]] * 3),
                  "cylinder": (CYLINDER, [2 * d[0], 2 * d[0], d[-1]])}[solid.shape]
    return _marker(header, solid.id, number, kind, solid.pose, solid.color, scale=_xyz(size))


def _world_object(header: m.Header, number: int, solid: m.WorldObject) -> Any:
    if solid.shape == "mesh":
        corners = [_point(solid.vertices[i]) for triangle in solid.triangles for i in triangle]
        return _marker(header, solid.id, number, TRIANGLE_LIST, solid.pose, solid.color, scale=_xyz((1, 1, 1)),
                       points=corners)
    if solid.shape in ("box", "sphere", "cylinder"):
        kind = {"box": CUBE, "sphere": SPHERE, "cylinder": CYLINDER}[solid.shape]
        size = (solid.size.x,) * 3 if solid.shape == "sphere" else (solid.size.x, solid.size.y, solid.size.z)
        return _marker(header, solid.id, number, kind, solid.pose, solid.color, scale=_xyz(size))
    loops = [solid.polygon] if solid.shape == "prism" else [
        _circle(radius) for radius in (solid.size.x / 2, solid.inner_radius)]
    return _edges(header, solid.id, number, solid.pose, solid.color, loops, solid.size.z)


def _circle(radius: float) -> list[tuple[float, float]]:
    turns = [2 * math.pi * k / 36 for k in range(36)]
    return [(radius * math.cos(a), radius * math.sin(a)) for a in turns]


def _edges(header: m.Header, ns: str, number: int, pose: m.Pose, color: m.Color,
           loops: Sequence[Sequence[tuple[float, float]]], height: float) -> Any:
    points = []
    for loop in loops:
        for start, end in zip(loop, [*loop[1:], *loop[:1]], strict=True):
            for z in (-height / 2, height / 2):
                points += [_point((*start, z)), _point((*end, z))]
    return _marker(header, ns, number, LINE_LIST, pose, color, scale=_xyz((THICKNESS, 0, 0)), points=points)


def _xyz(values: Sequence[float]) -> Any:
    x, y, z = map(float, values)
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _point(values: Sequence[float]) -> Any:
    x, y, z = map(float, values)
    return make("geometry_msgs/msg/Point", x=x, y=y, z=z)


def _vector(vector: m.Vector3) -> Any:
    return _xyz((vector.x, vector.y, vector.z))


def _quaternion(q: m.Quaternion) -> Any:
    return make("geometry_msgs/msg/Quaternion", x=q.x, y=q.y, z=q.z, w=q.w)


def _pose(pose: m.Pose) -> Any:
    p = pose.position
    return make("geometry_msgs/msg/Pose", position=_point((p.x, p.y, p.z)), orientation=_quaternion(pose.orientation))


def _color(color: m.Color) -> Any:
    return make("std_msgs/msg/ColorRGBA", r=color.r, g=color.g, b=color.b, a=color.a)


Conversion = tuple[type[m.Message], str, Callable[[Any], Any]]  # message, type of ROS, function
CONVERSIONS: list[Conversion] = [
    (m.JointState, "sensor_msgs/msg/JointState", joints),
    (m.TFMessage, "tf2_msgs/msg/TFMessage", transforms),
    (m.Image, "sensor_msgs/msg/Image", image),
    (m.CameraInfo, "sensor_msgs/msg/CameraInfo", calibration),
    (m.PointCloud2, "sensor_msgs/msg/PointCloud2", cloud),
    (m.PoseArray, "geometry_msgs/msg/PoseArray", poses),
    (m.MarkerArray, "visualization_msgs/msg/MarkerArray", markers),
    (m.PlanningScene, "visualization_msgs/msg/MarkerArray", scene),
    (m.WorldObjects, "visualization_msgs/msg/MarkerArray", world),
    (m.JointTrajectory, "trajectory_msgs/msg/JointTrajectory", trajectory),
    (m.MotionStatus, "diagnostic_msgs/msg/DiagnosticStatus", motion),
    (m.RobotStatus, "diagnostic_msgs/msg/DiagnosticStatus", robot),
    (m.TaskStatus, "diagnostic_msgs/msg/DiagnosticStatus", task),
    (m.SupervisorStatus, "diagnostic_msgs/msg/DiagnosticArray", processes),
]


def conversion_of(model: type[m.Message]) -> tuple[str, Callable[[Any], Any]] | None:
    """Return the type of ROS for messages of a class with the function that converts them; None if there is none."""
    return next(((name, convert) for kind, name, convert in CONVERSIONS if issubclass(model, kind)), None)
