"""Robotiq's 2F grippers on an arm of Universal Robots, inside their driver's process.

Their program on the arm's controller (the URCap) accepts lines of text on a port of its own: the answer to
`SET POS 255 GTO 1` is `ack`, the answer to `GET POS` is `POS 255`. Registers are those of Robotiq's manual of the
2F-85 and 2F-140, counts from 0 (open) to 255 (closed); the ends of the travel are a few counts inside. The gripper must
be activated once, at the pendant: that moves its fingers.
"""

from __future__ import annotations

import socket
import threading
from typing import Any, Literal, NamedTuple

from pydantic import Field

from common.config import GripperConfig, Parameters
from common.hardware.driven_gripper import DrivenGripper, FingerState

PORT = 63352
TIMEOUT = 1.0  # [s] for the answer to a line
LONGEST = 256  # bytes of an answer
ACTIVE = 3  # of STA
MOVING, HOLDING_OPENING, HOLDING_CLOSING = 0, 1, 2  # of OBJ; 3: at the requested position
COUNTS = 255


class Model(NamedTuple):
    """Width of the open gripper [m], counts at both ends, and the speeds and efforts of counts 0 and 255."""

    stroke: float
    open: int
    closed: int
    speeds: tuple[float, float]  # [m/s]
    efforts: tuple[float, float]  # [N]


MODELS = {
    "2f85": Model(0.085, 3, 228, (0.020, 0.150), (20.0, 235.0)),
    "2f140": Model(0.140, 3, 228, (0.030, 0.250), (10.0, 125.0)),
}


class GripperOptions(Parameters):
    """Address and model of the gripper."""

    host: str = Field(description="address of the arm's controller")
    model: Literal["2f85", "2f140"] = Field(description="model of the gripper")
    port: int = Field(PORT, ge=1, le=65535, description="port of the gripper's program (URCap)")


def create_gripper(gripper: GripperConfig, options: GripperOptions) -> DrivenGripper:
    """Create the gripper, in a process of its own."""
    return DrivenGripper(__name__, options.model_dump(), gripper, name=f"{options.model} at {options.host}")


def connect(options: dict[str, Any], config: GripperConfig) -> Robotiq:
    """Connect to the gripper, inside the driver's process; raise OSError when it does not answer."""
    return Robotiq(options["host"], MODELS[options["model"]], config.speed, options.get("port", PORT))


class Robotiq:
    """The connection to the gripper's program."""

    def __init__(self, host: str, model: Model, speed: float, port: int = PORT) -> None:
        """Connect; nothing moves. `speed` is of the opening between the fingers [m/s]."""
        self._model = model
        self._socket = socket.create_connection((host, port), TIMEOUT)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._line_lock = threading.Lock()  # `move` and `read` send one line at a time
        self._effort = 0.0
        if (state := self._get("STA")) != ACTIVE:
            raise RuntimeError(f"the gripper is not activated (state {state}): do that at the pendant")
        self._set(f"SET SPE {_counts(speed, model.speeds)}")

    def read(self) -> FingerState:
        """Return the newest state.

        Raises:
            RuntimeError: the gripper has a fault.
        """
        if fault := self._get("FLT"):
            raise RuntimeError(f"the gripper has fault {fault}: see its manual")
        status = self._get("OBJ")  # first: once the fingers have stopped, the position read next is final
        position = self._get("POS")
        model = self._model
        share = (model.closed - position) / (model.closed - model.open)
        holding = status in (HOLDING_OPENING, HOLDING_CLOSING)
        width = min(max(share, 0.0), 1.0) * model.stroke
        return FingerState(width, status == MOVING, holding, self._effort if holding else 0.0)

    def move(self, width: float, effort: float) -> None:
        """Start to move the fingers to a width [m]; they press on an object in between with an effort [N]."""
        model = self._model
        share = min(max(width / model.stroke, 0.0), 1.0)
        position = round(model.closed - share * (model.closed - model.open))
        force = _counts(effort, model.efforts)
        least, most = model.efforts
        self._effort = least + (most - least) * force / COUNTS
        self._set(f"SET POS {position} FOR {force} GTO 1")

    def stop(self) -> None:
        """Do nothing: `move` does not wait for the fingers."""

    def close(self) -> None:
        """Release the gripper; what it holds stays held."""
        self._socket.close()

    def _get(self, register: str) -> int:
        answer = self._exchange(f"GET {register}")
        name, _, value = answer.partition(" ")
        if name != register or not value.isdigit():
            raise RuntimeError(f"the gripper answers {answer[:40]!r} to GET {register}")
        return int(value)

    def _set(self, line: str) -> None:
        answer = self._exchange(line)
        if answer != "ack":
            raise RuntimeError(f"the gripper answers {answer[:40]!r} to {line}")

    def _exchange(self, line: str) -> str:
        """Return the answer to a line; the answer to SET may have no end of line."""
        with self._line_lock:
            self._socket.sendall(line.encode() + b"\n")
            answer = b""
            while not answer.endswith(b"\n") and answer != b"ack":
                try:
                    received = self._socket.recv(LONGEST)
                except TimeoutError:
                    raise ConnectionError("the gripper's program does not answer") from None
                if not received or len(answer) > LONGEST:
                    raise ConnectionError("the gripper's program has closed the connection")
                answer = (answer + received).lstrip()  # of the end of the previous line
        return answer.decode("ascii", "replace").strip()


def _counts(value: float, ends: tuple[float, float]) -> int:
    least, most = ends
    return round(min(max((value - least) / (most - least), 0.0), 1.0) * COUNTS)
