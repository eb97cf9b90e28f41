"""Names of the first releases: still read in messages and record files, written under the current name."""

import msgpack
import pytest

from common import messages as m
from common.control.interlocks import Record
from common.errors import DecodeError
from common.transport.codec import decode, encode

STOP = {"kind": "stopped", "by": "person", "since": 7}
NOW = {"kind": "stopped", "by": "operator", "since": 7}
TRAJECTORY = {"joint_names": ["a"], "points": []}


@pytest.mark.parametrize(("model", "former", "current"), [
    (m.TaskCommand, {"command": "start", "heard": 7, "by": "person"}, {"acknowledged": 7, "by": "operator"}),
    (m.HoldRequest, {"hold": False, "heard": 7, "by": "person"}, {"acknowledged": 7, "by": "operator"}),
    (m.ExecuteRequest, {"id": "a", "trajectory": TRAJECTORY, "heard": 7, "owner": "person"},
     {"acknowledged": 7, "owner": "operator"}),
    (m.GripperCommand, {"id": "a", "width": 0.1, "heard": 7, "owner": "person"},
     {"acknowledged": 7, "owner": "operator"}),
    (m.JogCommand, {"heard": 7, "owner": "person"}, {"acknowledged": 7, "owner": "operator"}),
    (m.StopRequest, {"by": "person", "owner": "person"}, {"by": "operator", "owner": "operator"}),
    (m.Interlock, STOP, {"by": "operator"}),
    (m.MotionStatus, {"inhibits": [STOP], "held_by": ["person", "watchdog"]},
     {"interlocks": [NOW | {"reason": ""}], "held_by": ["operator", "watchdog"]}),
    (m.OwnRequest, {"act": "take", "owner": "person"}, {"owner": "operator"}),
    (m.MotionOwner, {"owner": "person", "kind": "operator"}, {"owner": "operator"}),
    (m.RobotCommand, {"act": "enable", "owner": "person"}, {"owner": "operator"}),
])
def test_former_names_are_read_and_current_ones_written(model: type[m.Message], former, current) -> None:
    message = decode(model, msgpack.packb(former))
    written = msgpack.unpackb(encode(message))
    assert {name: written[name] for name in current} == current
    assert not written.keys() & {"heard", "inhibits"}
    assert decode(model, encode(message)) == message


def test_field_under_both_names_is_refused() -> None:
    with pytest.raises(DecodeError, match=r"TaskCommand\.heard: "):
        decode(m.TaskCommand, msgpack.packb({"command": "start", "heard": 1, "acknowledged": 2}))


def test_record_file_with_former_names_is_loaded() -> None:
    record = Record.model_validate_json('{"version": 1, "inhibits": [{"kind": "held", "by": "person", "since": 7}]}')
    assert record.interlocks == [m.Interlock(kind="held", by="operator", since=7)]
    assert '"interlocks"' in record.model_dump_json()
