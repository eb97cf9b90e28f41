"""Payloads of real messages with seeded changes of bytes or structure."""

import math
import random
from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import msgpack

from common import messages as m
from common.application import all_topics
from common.messages.basics import Message
from common.messages.schema import example_of

Strange = list[Any]

STRANGE: Strange = [
    "9" * 400, "1", "", "\x1b[2J", "[/x]", "\n", "a" * 200, "a" * 5000, "\u202e", "nan", "../..", None, True, False,
    0, -1, 2**31, 2**63 - 1, 2**63, 2**64 - 1, -(2**63), 1e5, 1e7, 1e12, 1e200, 1e308, -1e308, 5e-324, -0.0,
    math.nan, math.inf, -math.inf, b"", b"\xff" * 50, [], {}, [[]] * 300, [{}] * 300, [0] * 300, {"x": 0}, {"": {}},
    {str(i): i for i in range(300)}, msgpack.ExtType(5, b"abc"), msgpack.ExtType(1, b""), msgpack.Timestamp(2**33, 5),
]


def models() -> list[type[Message]]:
    """Return all messages of the platform and its applications, with requests and answers."""
    found = [model for topic in all_topics().values() for model in (topic.message, getattr(topic, "answer", None))]
    return sorted({model for model in found if model is not None}, key=lambda model: model.__name__)


def real(model: type[Message]) -> list[dict[str, Any]]:
    """Return realistic content of a message as maps."""
    return [message.model_dump() for message in _more() if type(message) is model] or [
        model.model_validate(example_of(model)).model_dump()]


def _more() -> Iterator[Message]:
    """Yield messages with many optional fields."""
    header = m.Header(stamp=1_763_737_000_123_456_789, frame_id="world")
    pose = m.Pose(position=m.Vector3(x=0.4, y=0.1, z=0.3))
    rest = [0.0] * 7
    points = [m.JointTrajectoryPoint(
        time_from_start=0.1 * i, positions=[0.1 * i] * 7, velocities=rest, accelerations=rest) for i in range(3)]
    names = [f"panda_joint{i}" for i in range(1, 8)]
    trajectory = m.JointTrajectory(header=header, joint_names=names, points=points)
    box = m.CollisionObject(id="box", role="fixture", shape="box", dimensions=[0.1, 0.1, 0.1], pose=pose)
    prism = m.CollisionObject(id="prism", role="target", shape="prism", dimensions=[0.1], pose=pose,
                              outline=[(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)])
    thing = m.WorldObject(id="ball_1", shape="mesh", pose=pose, vertices=[(0.0, 0.0, 0.0)] * 3, triangles=[(0, 1, 2)])
    old = m.WorldObject(id="block", shape="box", outline=[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    limits = m.PathConstraints(tilt=0.3, region=m.Box(pose=pose, size=m.Vector3(x=1.0, y=1.0, z=1.0)), tool_speed=0.2)
    goals = [m.JointGoal(positions=[0.1] * 7), m.PoseGoal(pose=pose), m.PathGoal(waypoints=[pose, pose], step=0.01),
             m.ArcGoal(pose=pose, via=m.Vector3(x=0.5)),
             m.SequenceGoal(items=[m.SequenceItem(goal=m.PoseGoal(pose=pose), blend_radius=0.0, straight=True)])]
    yield from (m.PlanRequest(header=header, id="a", stage="s", start=[0.1] * 7, goal=goal, attach_pose=pose,
                              allowed_collisions=[("a", "b")], planning_time=0.1, constraints=limits) for goal in goals)
    yield from (
        trajectory, m.ExecuteRequest(header=header, id="a", trajectory=trajectory),
        m.PlanResponse(id="a", ok=True, trajectory=trajectory, attempts=[m.PlanAttempt(planner="ompl", seconds=0.1)]),
        m.JointState(header=header, name=names, position=[0.0] * 7, velocity=[0.0] * 7, effort=[0.0] * 7),
        m.PoseArray(header=header, poses=[pose, pose], ids=["a", "b"], labels=["table", "held"]),
        m.PlanningScene(header=header, objects=[box, prism], attached=[m.AttachedObject(link="hand", object=box)]),
        m.WorldObjects(header=header, objects=[thing]), m.WorldObjects(objects=[old]),
        m.ServiceCounters(header=header, service="camera", writes=["a"], received={"a": 1}, dropped={"a": 2}),
        m.ParameterRequest(set={"services.camera_simulator.rate": 10.0, "motion.velocity_scaling": 0.2}),
        m.ParameterReply(service="a", parameters=[m.Parameter(path="a", value=[1, {"b": "c"}], type="list")]),
        m.MotionStatus(header=header, id="a", state="active", progress=0.5, held_by=["operator"]),
        m.SupervisorStatus(header=header, cell="panda", services=[m.ServiceStatus(name="a", state="ready", pid=1)]),
        m.Rejections(header=header, rejected=[m.Rejection(position=m.Vector3(), reason="far")]),
        m.Image(header=header, height=2, width=2, encoding="bgr8", data=bytes(12)),
        m.CameraInfo(header=header, height=480, width=640, k=[500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]),
        m.PointCloud2(header=header, height=1, width=1, row_step=16, data=bytes(16)),
        m.StopRequest(id="a"), m.HoldRequest(hold=True), m.HoldRequest(hold=False),
    )


class Mutations:
    """Changed payloads of messages, reproducible by their seed."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self._real = {model: real(model) for model in models()}
        self._packed = {model: [msgpack.packb(each) for each in values] for model, values in self._real.items()}

    def payload(self, model: type[Message]) -> bytes:
        """Return a changed payload of a message."""
        if self.random.random() < 0.5:
            return self._bytes(bytearray(self.random.choice(self._packed[model])))
        value = msgpack.unpackb(self.random.choice(self._packed[model]))
        for _ in range(self.random.choice((1, 1, 1, 2, 5))):
            value = self._structure(value)
        packed: bytes = msgpack.packb(value)
        return packed

    def _bytes(self, payload: bytearray) -> bytes:
        draw = self.random
        for _ in range(draw.choice((1, 1, 2, 8))):
            at = draw.randrange(len(payload) + 1)
            match draw.randrange(6):
                case 0 if at < len(payload):
                    payload[at] ^= 1 << draw.randrange(8)
                case 1 if at < len(payload):
                    payload[at] = draw.choice((0x80, 0x90, 0xC0, 0xC1, 0xC7, 0xCB, 0xCF, 0xD9, 0xDB, 0xDD, 0xDF, 0xFF))
                case 2:
                    payload[at:at] = draw.randbytes(draw.randrange(1, 5))
                case 3:
                    del payload[at : at + draw.randrange(1, 9)]
                case 4:
                    payload[at:at] = payload[at : at + draw.randrange(1, 40)] * draw.choice((1, 2, 50))
                case 5:
                    del payload[at:]
        return bytes(payload)

    def _structure(self, value: Any) -> Any:
        """Return the value with one change at any level."""
        draw = self.random
        if isinstance(value, dict) and value and draw.random() < 0.9:
            name = draw.choice(list(value))
            match draw.randrange(8):
                case 0:
                    value.pop(name)
                case 1:
                    value[draw.choice(("extra", "", "\x1b", "header"))] = deepcopy(draw.choice(STRANGE))
                case _:
                    value[name] = self._structure(value[name])
            return value
        if isinstance(value, list) and value and draw.random() < 0.9:
            at = draw.randrange(len(value))
            match draw.randrange(6):
                case 0:
                    del value[at]
                case 1 if len(value) < 500:
                    return value * draw.choice((2, 10, 300))
                case _:
                    value[at] = self._structure(value[at])
            return value
        if isinstance(value, int | float) and not isinstance(value, bool) and draw.random() < 0.3:
            return float(value) * draw.choice((-1, 10, 1e3, 1e6)) if draw.random() < 0.7 else str(value)
        return deepcopy(draw.choice(STRANGE))
