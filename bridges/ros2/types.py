"""Message types of ROS 2 with their hashes, and their encoding in CDR, by `rosbags`.

The types are those of ROS 2 Jazzy; all that are used here have the same hashes in Kilted, except the feedback of
FollowJointTrajectory: since version 6.3 of control_msgs it has the indices of its points (`INDEXED`).
"""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

TRIGGER = "std_srvs/srv/Trigger"
CANCEL = "action_msgs/srv/CancelGoal"
FOLLOW = "control_msgs/action/FollowJointTrajectory"
EVENT_INFO = "service_msgs/msg/ServiceEventInfo"

Variant = Literal["jazzy", "indexed"]  # of the definitions
JAZZY: Variant = "jazzy"
INDEXED: Variant = "indexed"
FieldDesc = Any  # of rosbags: a pair of kind and element
Fields = list[tuple[str, FieldDesc]]


@cache
def store(variant: Variant = JAZZY) -> Typestore:
    """Return all types by name, with services and the action as structures of their own."""
    types = get_typestore(Stores.ROS2_JAZZY)
    # A `char` of a .msg file is a uint8 in ROS 2 (rosidl_adapter), also in the hash; rosbags hashes it as a char.
    constants, fields = types.fielddefs[EVENT_INFO]
    types.fielddefs[EVENT_INFO] = (
        constants, [(name, _array("uint8", 16) if name == "client_gid" else field) for name, field in fields])
    for name, defined in {**_control_types(), **_service_types(), **_action_types(variant)}.items():
        types.register({name: ([], defined)})
    return types


@cache
def type_hash(name: str, variant: Variant = JAZZY) -> str:
    """Return the hash of a type, such as RIHS01_a13e... of sensor_msgs/msg/JointState."""
    return str(store(variant).hash_rihs01(name))


def dds_name(name: str) -> str:
    """Return the name of a type in keys: sensor_msgs::msg::dds_::JointState_ of sensor_msgs/msg/JointState."""
    package, kind, last = name.split("/")
    return f"{package}::{kind}::dds_::{last}_"


def make(name: str, variant: Variant = JAZZY, /, **fields: Any) -> Any:
    """Return a message of a type; fields that are not given have their default: zero or empty."""
    defined = store(variant).fielddefs[name][1]
    unknown = fields.keys() - {field for field, _ in defined}
    if unknown:
        raise TypeError(f"{name} has no field {', '.join(sorted(unknown))}")
    values = {field: fields[field] if field in fields else _default(desc) for field, desc in defined}
    return store(variant).types[name](**values)


def encode(message: Any, variant: Variant = JAZZY) -> bytes:
    """Return a message as little-endian CDR (XCDR1) with its header of four bytes."""
    return bytes(store(variant).serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, name: str) -> Any:
    """Return the message of a payload.

    Raises:
        ValueError: it is not valid CDR of that type.
    """
    try:
        return store().deserialize_cdr(data, name)
    except Exception as error:
        raise ValueError(f"not a {name}: {error or type(error).__name__}") from None


def _default(desc: FieldDesc) -> Any:
    kind, rest = desc
    if kind == Nodetype.NAME:
        return make(str(rest))
    if kind == Nodetype.BASE:
        base = rest[0]
        return "" if base == "string" else False if base == "bool" else 0.0 if str(base).startswith("float") else 0
    (item, of), count = rest
    if item == Nodetype.BASE and of[0] != "string":
        return np.zeros(count if kind == Nodetype.ARRAY else 0, dtype=of[0])
    return [_default((item, of)) for _ in range(count)] if kind == Nodetype.ARRAY else []


def _base(name: str) -> FieldDesc:
    return Nodetype.BASE, (name, 0)


def _name(name: str) -> FieldDesc:
    return Nodetype.NAME, name


def _array(base: str, count: int) -> FieldDesc:
    return Nodetype.ARRAY, ((Nodetype.BASE, (base, 0)), count)


def _sequence(item: FieldDesc, limit: int = 0) -> FieldDesc:
    return Nodetype.SEQUENCE, (item, limit)


def _service(name: str, request: Fields, response: Fields) -> dict[str, Fields]:
    """Return the structures of a service; its hash is that of the structure with its own name."""
    return {
        f"{name}_Request": request,
        f"{name}_Response": response,
        f"{name}_Event": [("info", _name(EVENT_INFO)), ("request", _sequence(_name(f"{name}_Request"), 1)),
                          ("response", _sequence(_name(f"{name}_Response"), 1))],
        name: [("request_message", _name(f"{name}_Request")), ("response_message", _name(f"{name}_Response")),
               ("event_message", _name(f"{name}_Event"))],
    }


def _control_types() -> dict[str, Fields]:
    values: Fields = [(name, _base("float64")) for name in ("position", "velocity", "acceleration")]
    return {
        "control_msgs/msg/JointTolerance": [("name", _base("string")), *values],
        "control_msgs/msg/JointComponentTolerance": [
            ("joint_name", _base("string")), ("component", _base("uint16")), *values],
    }


def _service_types() -> dict[str, Fields]:
    info = _name("action_msgs/msg/GoalInfo")
    return {
        **_service(TRIGGER, [], [("success", _base("bool")), ("message", _base("string"))]),
        **_service(CANCEL, [("goal_info", info)],
                   [("return_code", _base("int8")), ("goals_canceling", _sequence(info))]),
    }


def _action_types(variant: Variant) -> dict[str, Fields]:
    indexed = variant == INDEXED
    tolerances = _sequence(_name("control_msgs/msg/JointTolerance"))
    components = _sequence(_name("control_msgs/msg/JointComponentTolerance"))
    point = _name("trajectory_msgs/msg/JointTrajectoryPoint")
    multi_point = _name("trajectory_msgs/msg/MultiDOFJointTrajectoryPoint")
    names, goal_id = _sequence(_base("string")), _name("unique_identifier_msgs/msg/UUID")
    goal: Fields = [
        ("trajectory", _name("trajectory_msgs/msg/JointTrajectory")),
        ("multi_dof_trajectory", _name("trajectory_msgs/msg/MultiDOFJointTrajectory")),
        ("path_tolerance", tolerances), ("component_path_tolerance", components),
        ("goal_tolerance", tolerances), ("component_goal_tolerance", components),
        ("goal_time_tolerance", _name("builtin_interfaces/msg/Duration")),
    ]
    feedback: Fields = [
        ("header", _name("std_msgs/msg/Header")), ("joint_names", names),
        ("desired", point), ("actual", point), ("error", point),
        *([("index", _base("int32"))] if indexed else []), ("multi_dof_joint_names", names),
        ("multi_dof_desired", multi_point), ("multi_dof_actual", multi_point), ("multi_dof_error", multi_point),
        *([("multi_dof_index", _base("int32"))] if indexed else []),
    ]
    return {
        f"{FOLLOW}_Goal": goal,
        f"{FOLLOW}_Result": [("error_code", _base("int32")), ("error_string", _base("string"))],
        f"{FOLLOW}_Feedback": feedback,
        f"{FOLLOW}_FeedbackMessage": [("goal_id", goal_id), ("feedback", _name(f"{FOLLOW}_Feedback"))],
        **_service(f"{FOLLOW}_SendGoal", [("goal_id", goal_id), ("goal", _name(f"{FOLLOW}_Goal"))],
                   [("accepted", _base("bool")), ("stamp", _name("builtin_interfaces/msg/Time"))]),
        **_service(f"{FOLLOW}_GetResult", [("goal_id", goal_id)],
                   [("status", _base("int8")), ("result", _name(f"{FOLLOW}_Result"))]),
    }
