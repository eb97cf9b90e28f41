"""The controller of an arm of Universal Robots, as its network sees it: RTDE (version 2), dashboard and script ports.

It is made of what a client library may observe: output and input registers, robot and safety modes, a program that
answers to commands in registers. URScript is not interpreted: of the program that `ur_rtde` uploads only the commands
are known that move the arm, stop it and set its payload. Joints follow `servoj` with the lookahead that is asked for.

`python -m tests.doubles.ur_controller --host 127.0.0.2` runs it; lines to port 29919 make it misbehave.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

RTDE, DASHBOARD, SCRIPTS, ORDERS = 30004, 29999, (30001, 30002, 30003), 29919
RATE = 500.0  # [Hz]
OUTPUT_MASKS = {f"{kind}_digital_output_mask": 8 * n for n, kind in enumerate(("standard", "configurable", "tool"))}
COMMAND = "input_int_register_0"  # to the program
POWER_OFF, IDLE, RUNNING = 3, 5, 7  # robot modes
NORMAL, PROTECTIVE_STOP, EMERGENCY_STOP = 1, 3, 7  # safety modes
MODES = {POWER_OFF: "POWER_OFF", IDLE: "IDLE", RUNNING: "RUNNING"}
SAFETY = {NORMAL: "NORMAL", PROTECTIVE_STOP: "PROTECTIVE_STOP", EMERGENCY_STOP: "ROBOT_EMERGENCY_STOP"}
SPEED, ACCELERATION = 3.3, 60.0  # of a joint, beyond which it stops for protection [rad/s], [rad/s^2]
SERVOJ, SPEED_STOP, SERVO_STOP, PAYLOAD, TEACH, END_TEACH, STOP_SCRIPT = 11, 15, 16, 17, 18, 19, 255

LONGEST_TURN = 0.02  # [s]
FORMATS = {"DOUBLE": "d", "UINT64": "Q", "UINT32": "I", "INT32": "i", "UINT8": "B", "VECTOR6D": "6d", "VECTOR3D": "3d",
           "VECTOR6INT32": "6i"}
VARIABLES = {
    "DOUBLE": """timestamp payload actual_execution_time speed_scaling target_speed_fraction actual_momentum
        actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1
        standard_analog_output0 standard_analog_output1 standard_analog_output_0 standard_analog_output_1
        speed_slider_fraction""",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
    "UINT32": "runtime_state robot_status_bits safety_status_bits speed_slider_mask",
    "INT32": "robot_mode safety_mode safety_status",
    "UINT8": """standard_digital_output_mask configurable_digital_output_mask tool_digital_output_mask
        standard_digital_output configurable_digital_output tool_digital_output standard_analog_output_mask
        standard_analog_output_type""",
    "VECTOR6D": """target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current
        joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed
        joint_temperatures actual_joint_voltage ft_raw_wrench actual_current_as_torque payload_inertia
        external_force_torque""",
    "VECTOR3D": "payload_cog actual_tool_accelerometer",
    "VECTOR6INT32": "joint_mode",
}
KINDS = {name: kind for kind, names in VARIABLES.items() for name in names.split()}


def kind_of(name: str) -> str:
    """The type of a variable of the RTDE interface, or that there is none of that name."""
    if "int_register" in name:
        return "INT32"
    if "double_register" in name:
        return "DOUBLE"
    if "bit_registers" in name:
        return "UINT32"
    return KINDS.get(name, "NOT_FOUND")


@dataclass
class Arm:
    """Joints, modes and registers: one step of the controller every 1 / RATE seconds."""

    q: np.ndarray
    cb3: bool = False
    mode: int = RUNNING
    safety: int = NORMAL
    slider: float = 1.0
    slow: float = 0.0  # [s] that packets come late
    program: bool = False
    freedrive: bool = False
    payload: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    outputs: int = 0
    ints_in: list[int] = field(default_factory=lambda: [0] * 48)
    doubles_in: list[float] = field(default_factory=lambda: [0.0] * 48)
    ints_out: list[int] = field(default_factory=lambda: [0] * 48)
    doubles_out: list[float] = field(default_factory=lambda: [0.0] * 48)
    began: float = field(default_factory=time.monotonic)
    stops: int = 0  # for protection
    reason: str = ""
    commands: int = 0  # to move, that came
    fastest: float = 0.0  # [rad/s], [rad/s^2] that the joints were moved with
    hardest: float = 0.0

    def __post_init__(self) -> None:
        """Rest."""
        self.qd = np.zeros(6)
        self.target = self.q.copy()
        self._lookahead = 0.03
        self._doing = 0
        self._silent = 0.0  # [s] since a packet came
        self._patience = 0.0  # [s] without a packet, after which a watched program ends

    def step(self, seconds: float) -> None:
        """Answer to the command in the registers, and move on."""
        if self.program:
            self._obey(self.ints_in[0])
        able = self.mode == RUNNING and self.safety == NORMAL
        if able and self.program and 0 < self._patience < self._silent:
            self.reason = f"watchdog: nothing came for {self._silent:.2f} s"
            sys.stderr.write(f"{self.reason}\n")
            self.end_program()
        servoing = able and self.program and self._doing == SERVOJ
        off = self.target - self.q if servoing else 0.0 * self.q
        wanted = off / max(self._lookahead, 2 * seconds) * self.slider
        change = (wanted - self.qd) / seconds
        if servoing and (np.any(np.abs(wanted) > SPEED) or np.any(np.abs(change) > 10 * ACCELERATION)):
            self.protect(f"joints would move at {np.abs(wanted).max():.2f} rad/s, {np.abs(change).max():.0f} rad/s^2")
            return
        allowed = ACCELERATION * seconds
        qd = self.qd + np.clip(wanted - self.qd, -allowed, allowed)
        self.fastest = max(self.fastest, float(np.abs(qd).max()))
        self.hardest = max(self.hardest, float(np.abs(qd - self.qd).max() / seconds))
        self.qd = qd
        self.q = self.q + self.qd * seconds

    def _obey(self, command: int) -> None:
        if command == 0:
            self.ints_out[0] = 1  # ready
            return
        if command == SERVOJ:
            self.target = np.array(self.doubles_in[:6])
            self._lookahead = self.doubles_in[9]
            self._doing, self.commands, self.ints_out[0] = SERVOJ, self.commands + 1, 1
            return  # what comes in a stream is not acknowledged
        if self.ints_out[0] == 1:
            if command in (SPEED_STOP, SERVO_STOP):
                self._doing = 0
            elif command == PAYLOAD:
                self.payload = tuple(self.doubles_in[:4])
            elif command in (TEACH, END_TEACH):
                self.freedrive = command == TEACH
            elif command == STOP_SCRIPT:
                self.end_program()
            elif command == WATCHDOG and self.doubles_in[0] > 0:
                self._patience = 1.0 / self.doubles_in[0]
        self.ints_out[0] = 2  # done

    def passed(self, seconds: float) -> None:
        """So much time has passed in which packets were read; a machine that stalls is no silence."""
        self._silent += min(seconds, LONGEST_TURN)

    def heard(self) -> None:
        """A packet came."""
        self._silent = 0.0

    def start_program(self) -> None:
        """Run what was uploaded, if the arm can."""
        if self.mode == RUNNING and self.safety == NORMAL:
            self.program, self.freedrive, self._doing, self._patience = True, False, 0, 0.0
            self.ints_out[0] = 1
            self.heard()

    def end_program(self) -> None:
        """The arm brakes, and needs a new upload."""
        self.program, self.freedrive, self._doing = False, False, 0
        self.ints_out[0] = 0

    def protect(self, reason: str) -> None:
        """Stop for protection."""
        self.safety, self.reason, self.stops = PROTECTIVE_STOP, reason, self.stops + 1
        self.end_program()
        sys.stderr.write(f"protective stop: {reason}\n")

    def known(self) -> dict[str, object]:
        """What outputs say now, but for registers; all else is 0."""
        powered = self.mode in (IDLE, RUNNING)
        q, qd = self.q.tolist(), self.qd.tolist()
        return {
            "timestamp": time.monotonic() - self.began, "actual_q": q, "actual_qd": qd, "target_q": q,
            "target_qd": qd, "robot_mode": self.mode, "safety_mode": self.safety, "safety_status": self.safety,
            "runtime_state": 2 if self.program else 1, "robot_status_bits": powered | (self.program << 1),
            "safety_status_bits": {PROTECTIVE_STOP: 4, EMERGENCY_STOP: 0xC0}.get(self.safety, 1),
            "speed_scaling": self.slider, "target_speed_fraction": self.slider,
            "actual_digital_output_bits": self.outputs, "payload": self.payload[0], "payload_cog": self.payload[1:],
            "joint_mode": (253 if self.mode == RUNNING else 239,) * 6, "actual_main_voltage": 48.0,
            "actual_robot_voltage": 48.0,
        }

    def dashboard(self, line: str) -> str:  # noqa: PLR0912
        """The answer to a line."""
        match line.strip().lower():
            case "polyscopeversion":
                return f"URSoftware {'3.15.8.106339' if self.cb3 else '5.12.6.1102099'} (Sep 21 2023)"
            case "robotmode":
                return f"Robotmode: {MODES[self.mode]}"
            case "safetymode":
                return f"Safetymode: {SAFETY[self.safety]}"
            case "safetystatus":
                return f"Safetystatus: {SAFETY[self.safety]}"
            case "is in remote control":
                return "true"
            case "running":
                return f"Program running: {str(self.program).lower()}"
            case "programstate":
                return "PLAYING rtde_control" if self.program else "STOPPED rtde_control"
            case "get robot model":
                return "UR5"
            case "get serial number":
                return "20195500001"
            case "power on":
                self.mode = max(self.mode, IDLE)
                return "Powering on"
            case "power off":
                self.mode = POWER_OFF
                self.end_program()
                return "Powering off"
            case "brake release":
                self.mode = RUNNING
                return "Brake releasing"
            case "unlock protective stop":
                if self.safety == PROTECTIVE_STOP:
                    self.safety, self.reason = NORMAL, ""
                return "Protective stop releasing"
            case "close safety popup":
                return "closing safety popup"
            case "stop":
                self.end_program()
                return "Stopped"
            case "quit":
                return "Disconnected"
            case other:
                return f"could not understand: '{other}'"


WATCHDOG = 35  # by what ur_rtde 1.6 sends


class Controller:
    """The ports."""

    def __init__(self, host: str, arm: Arm) -> None:
        """Nothing listens yet."""
        self.host, self.arm = host, arm
        self._servers: list[asyncio.Server] = []
        self._writers: set[asyncio.StreamWriter] = set()
        self._inputs: dict[str, asyncio.StreamWriter] = {}  # who sets each of them
        self.pulled_until = 0.0  # monotonic [s]: the cable carries nothing until then

    async def listen(self) -> None:
        """Open the ports of the controller."""
        ports = {RTDE: self._rtde, DASHBOARD: self._dashboard, **dict.fromkeys(SCRIPTS, self._script)}
        for port, serve in ports.items():
            self._servers.append(await asyncio.start_server(self._kept(serve), self.host, port))

    def _kept(self, serve: Callable) -> Callable:
        async def served(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self._writers.add(writer)
            try:
                with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
                    await serve(reader, writer)
            finally:
                self._writers.discard(writer)
                writer.close()
        return served

    async def reboot(self, seconds: float) -> None:
        """Be gone for so long, and come back without power at the joints."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        for writer in list(self._writers):
            writer.transport.abort()
        self.arm.end_program()
        self.arm.mode, self.arm.safety = POWER_OFF, NORMAL
        await asyncio.sleep(seconds)
        await self.listen()

    async def run(self) -> None:
        """Move the arm."""
        due = last = heard = time.monotonic()
        while True:
            now = time.monotonic()
            self.arm.passed(now - heard)
            heard = now
            while last + 1 / RATE <= now:
                self.arm.step(1 / RATE)
                last += 1 / RATE
                await asyncio.sleep(0)  # a machine that stalls: what came meanwhile is heard between steps, not at once
            due = max(due + 1 / RATE, now)
            await asyncio.sleep(due - time.monotonic())

    async def carried(self) -> None:
        """Wait until the cable is in."""
        await asyncio.sleep(max(0.0, self.pulled_until - time.monotonic()))

    async def _rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        recipes: dict[int, list[str]] = {}
        sender: asyncio.Task | None = None

        def answer(kind: int, payload: bytes) -> None:
            writer.write(struct.pack(">HB", 3 + len(payload), kind) + payload)

        async def send(period: float) -> None:
            due = time.monotonic()
            while True:
                await self.carried()
                for recipe in outputs.values():
                    answer(ord("U"), recipe.packed(self.arm))
                await writer.drain()
                due = max(due + period, time.monotonic())
                await asyncio.sleep(due - time.monotonic() + self.arm.slow)

        outputs: dict[int, Recipe] = {}
        period = 1 / RATE
        try:
            while True:
                size, kind = struct.unpack(">HB", await reader.readexactly(3))
                payload = await reader.readexactly(size - 3)
                await self.carried()
                match chr(kind):
                    case "V":
                        answer(kind, b"\x01")
                    case "v":
                        answer(kind, struct.pack(">4I", *((3, 15, 8, 0) if self.arm.cb3 else (5, 12, 6, 0))))
                    case "O":
                        period = 1 / struct.unpack(">d", payload[:8])[0]
                        names, kinds = variables(payload[8:])
                        number = 0 if "NOT_FOUND" in kinds else len(outputs) + 1
                        if number:
                            outputs[number] = Recipe(number, names)
                        answer(kind, struct.pack(">B", number) + ",".join(kinds).encode())
                    case "I":
                        names, kinds = variables(payload)
                        for n, name in enumerate(names):  # one client at a time may set each
                            if self._inputs.setdefault(name, writer) is not writer:
                                kinds[n] = "IN_USE"
                        recipes[len(recipes) + 1] = names
                        answer(kind, struct.pack(">B", len(recipes)) + ",".join(kinds).encode())
                    case "S":
                        answer(kind, b"\x01")
                        if sender is None:
                            sender = asyncio.create_task(send(period))
                    case "P":
                        answer(kind, b"\x01")
                        if sender is not None:
                            sender.cancel()
                            sender = None
                    case "U":
                        names = recipes[payload[0]]
                        if self._inputs.get(COMMAND) is writer:  # the program in the arm watches who commands it
                            self.arm.heard()
                        if all(self._inputs.get(name) is writer for name in names):
                            self._take(names, payload[1:])
                    case other:
                        raise NotImplementedError(f"packet {other}")
                await writer.drain()
        finally:
            self._inputs = {name: owner for name, owner in self._inputs.items() if owner is not writer}
            if sender is not None:
                sender.cancel()

    def _take(self, names: list[str], payload: bytes) -> None:
        offset, changed = 0, 0
        for name in names:
            shape = ">" + FORMATS[kind_of(name)]
            value = struct.unpack_from(shape, payload, offset)[0]
            offset += struct.calcsize(shape)
            head, _, number = name.rpartition("_")
            if head == "input_int_register":
                self.arm.ints_in[int(number)] = value
            elif head == "input_double_register":
                self.arm.doubles_in[int(number)] = value
            elif name == "speed_slider_fraction":
                self.arm.slider = value
            elif name in OUTPUT_MASKS:
                changed = value << OUTPUT_MASKS[name]
            elif f"{name}_mask" in OUTPUT_MASKS:
                levels = value << OUTPUT_MASKS[f"{name}_mask"]
                self.arm.outputs = self.arm.outputs & ~changed | levels & changed

    async def _dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            await self.carried()
            writer.write(self.arm.dashboard(line.decode()).encode() + b"\n")
            await writer.drain()

    async def _script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        text = b""
        while chunk := await reader.read(65536):
            await self.carried()
            text += chunk
            if text.rstrip().endswith(b"end"):
                if b"def rtde_control" in text:
                    self.arm.start_program()
                text = b""

    async def orders(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Lines of a test: what to do, answered by how the arm is."""
        while line := await reader.readline():
            words = line.decode().split()
            match words:
                case ["protect"]:
                    self.arm.protect("as a test asked")
                case ["emergency"]:
                    self.arm.safety = EMERGENCY_STOP
                    self.arm.end_program()
                case ["end"]:
                    self.arm.end_program()
                case ["normal"]:
                    self.arm.safety = NORMAL
                case ["slider", share]:
                    self.arm.slider = float(share)
                case ["slow", seconds]:
                    self.arm.slow = float(seconds)
                case ["pull", seconds]:
                    self.pulled_until = time.monotonic() + float(seconds)
                case ["reboot", seconds]:
                    self._rebooting = asyncio.create_task(self.reboot(float(seconds)))
            arm = self.arm
            writer.write(json.dumps({
                "q": arm.q.tolist(), "qd": arm.qd.tolist(), "mode": MODES[arm.mode], "safety": SAFETY[arm.safety],
                "program": arm.program, "stops": arm.stops, "reason": arm.reason, "commands": arm.commands,
                "fastest": arm.fastest, "hardest": arm.hardest, "payload": arm.payload, "slider": arm.slider,
                "outputs": arm.outputs,
                "freedrive": arm.freedrive,
            }).encode() + b"\n")
            await writer.drain()


def variables(payload: bytes) -> tuple[list[str], list[str]]:
    """Names of what a client asks for, and their types."""
    names = [name for name in payload.decode().split(",") if name]
    return names, [kind_of(name) for name in names]


class Recipe:
    """Outputs that are sent together."""

    def __init__(self, number: int, names: list[str]) -> None:
        """By their names."""
        self._number = number
        self._struct = struct.Struct(">B" + "".join(FORMATS[kind_of(name)] for name in names))
        self._getters = [(name, *_slot(name)) for name in names]
        self._counts = [int(FORMATS[kind_of(name)][:-1] or 1) for name in names]

    def packed(self, arm: Arm) -> bytes:
        """The bytes of all of them now."""
        known = arm.known()
        values: list[float] = [self._number]
        for (name, bank, index), count in zip(self._getters, self._counts, strict=True):
            if bank:
                values.append(getattr(arm, bank)[index])
            elif count == 1:
                values.append(known.get(name, 0))
            else:
                values += known.get(name, (0,) * count)
        return self._struct.pack(*values)


def _slot(name: str) -> tuple[str, int]:
    """Which registers an output is of, and its number."""
    head, _, number = name.rpartition("_")
    bank = {"output_int_register": "ints_out", "output_double_register": "doubles_out"}.get(head, "")
    return bank, int(number) if bank else 0


async def serve(host: str, q: list[float], cb3: bool, off: bool) -> None:
    """Run until cancelled."""
    controller = Controller(host, Arm(np.array(q), cb3, POWER_OFF if off else RUNNING))
    await controller.listen()
    await asyncio.start_server(controller.orders, host, ORDERS)
    sys.stdout.write("listening\n")
    sys.stdout.flush()
    await controller.run()


def main() -> None:
    """Run the controller of an arm."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--q", default="0,-1.57,0,-1.57,0,0")
    parser.add_argument("--cb3", action="store_true")
    parser.add_argument("--off", action="store_true", help="without power at the joints")
    args = parser.parse_args()
    with contextlib.suppress(OSError):  # a controller has a processor of its own
        os.nice(-10)
    asyncio.run(serve(args.host, [float(x) for x in args.q.split(",")], args.cb3, args.off))


if __name__ == "__main__":
    main()
