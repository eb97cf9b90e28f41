"""Robotiq's 2F grippers on an arm of Universal Robots, from inside their driver's process.

Their program on the arm's controller (the URCap) listens at a port of its own for lines of text: `SET POS 255 GTO 1` is
answered by `ack`, `GET POS` by `POS 255`. Registers are those of Robotiq's manual of the 2F-85 and 2F-140, counts from
0 (open) to 255 (closed); the ends of their travel are a few counts inside. The gripper has to be activated once, at
the pendant: that moves its fingers.
"""

from __future__ import annotations

import socket
import threading
from typing import Any, NamedTuple

from common.config import GripperConfig
from common.hardware.driven_gripper import Fingers

PORT = 63352
ANSWERS = 1.0  # [s] in which a line is answered
LONGEST = 256  # bytes of an answer
ACTIVE = 3  # of STA
MOVING, ON_OPENING, ON_CLOSING = 0, 1, 2  # of OBJ; 3 is there
COUNTS = 255


class Model(NamedTuple):
    """Width where it is open [m], counts at both ends, and what 0 and 255 counts of speed and effort stand for."""

    stroke: float
    open: int
    closed: int
    speeds: tuple[float, float]  # [m/s]
    efforts: tuple[float, float]  # [N]


MODELS = {
    "2f85": Model(0.085, 3, 228, (0.020, 0.150), (20.0, 235.0)),
    "2f140": Model(0.140, 3, 228, (0.030, 0.250), (10.0, 125.0)),
}


def connect(options: dict[str, Any], config: GripperConfig) -> Robotiq:
    """The gripper; raises OSError when nobody answers."""
    return Robotiq(options["host"], MODELS[options["model"]], config.speed, options.get("port", PORT))


class Robotiq:
    """The connection to the gripper's program."""

    def __init__(self, host: str, model: Model, speed: float, port: int = PORT) -> None:
        """Connect; nothing moves. `speed` is of the opening between the fingers [m/s]."""
        self._model = model
        self._socket = socket.create_connection((host, port), ANSWERS)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._asking = threading.Lock()  # one line at a time, of `move` and `read`
        self._effort = 0.0
        if (state := self._get("STA")) != ACTIVE:
            raise RuntimeError(f"the gripper is not activated (state {state}): do that at the pendant")
        self._say(f"SET SPE {_counts(speed, model.speeds)}")

    def read(self) -> Fingers:
        """The newest state.

        Raises:
            RuntimeError: the gripper has a fault.
        """
        if fault := self._get("FLT"):
            raise RuntimeError(f"the gripper has fault {fault}: see its manual")
        position, seen = self._get("POS"), self._get("OBJ")
        model = self._model
        share = (model.closed - position) / (model.closed - model.open)
        holding = seen in (ON_OPENING, ON_CLOSING)
        width = min(max(share, 0.0), 1.0) * model.stroke
        return Fingers(width, seen == MOVING, holding, self._effort if holding else 0.0)

    def move(self, width: float, effort: float) -> None:
        """Begin to bring the fingers to a width [m]; on what is in the way they press with an effort [N]."""
        model = self._model
        share = min(max(width / model.stroke, 0.0), 1.0)
        position = round(model.closed - share * (model.closed - model.open))
        force = _counts(effort, model.efforts)
        least, most = model.efforts
        self._effort = least + (most - least) * force / COUNTS
        self._say(f"SET POS {position} FOR {force} GTO 1")

    def stop(self) -> None:
        """Nothing waits for the fingers."""

    def close(self) -> None:
        """Let go of the gripper; what it holds stays held."""
        self._socket.close()

    def _get(self, register: str) -> int:
        answer = self._ask(f"GET {register}")
        name, _, value = answer.partition(" ")
        if name != register or not value.isdigit():
            raise RuntimeError(f"the gripper answers {answer[:40]!r} to GET {register}")
        return int(value)

    def _say(self, line: str) -> None:
        answer = self._ask(line)
        if answer != "ack":
            raise RuntimeError(f"the gripper answers {answer[:40]!r} to {line}")

    def _ask(self, line: str) -> str:
        """The answer to a line; one to SET may come without an end of line."""
        with self._asking:
            self._socket.sendall(line.encode() + b"\n")
            answer = b""
            while not answer.endswith(b"\n") and answer != b"ack":
                try:
                    more = self._socket.recv(LONGEST)
                except TimeoutError:
                    raise ConnectionError("the gripper's program does not answer") from None
                if not more or len(answer) > LONGEST:
                    raise ConnectionError("the gripper's program is gone")
                answer = (answer + more).lstrip()  # of the end of the line before
        return answer.decode("ascii", "replace").strip()


def _counts(value: float, ends: tuple[float, float]) -> int:
    least, most = ends
    return round(min(max((value - least) / (most - least), 0.0), 1.0) * COUNTS)
