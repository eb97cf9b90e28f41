"""Controller of an arm of Universal Robots, as seen from the network: RTDE (version 2), dashboard and script ports.

It does not interpret URScript: the arm executes the commands in the registers once a program is uploaded.

`python -m tests.doubles.ur_controller --host 127.0.0.2` runs it; lines to port 29919 inject faults.
"""

import argparse
import asyncio
import contextlib
import json
import os
import struct
import sys
import time
from collections.abc import Callable

import numpy as np

from tests.doubles.ur_arm import EMERGENCY_STOP, MODES, NORMAL, POWER_OFF, RUNNING, Arm

RTDE, DASHBOARD, SCRIPTS, ORDERS = 30004, 29999, (30001, 30002, 30003), 29919
RATE = 500.0  # [Hz]
COMMAND = "input_int_register_0"
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
REGISTERS = {"int_register": "INT32", "double_register": "DOUBLE", "bit_registers": "UINT32"}


def kind_of(name: str) -> str:
    """Return the RTDE type of a variable, NOT_FOUND for an unknown one."""
    return next((kind for part, kind in REGISTERS.items() if part in name), KINDS.get(name, "NOT_FOUND"))


def variables(payload: bytes) -> tuple[list[str], list[str]]:
    """Return the names that a client requests, and their types."""
    names = [name for name in payload.decode().split(",") if name]
    return names, [kind_of(name) for name in names]


class Recipe:
    """Outputs that are sent in one packet."""

    def __init__(self, number: int, names: list[str]) -> None:
        self._number, self._names = number, names
        self._struct = struct.Struct(">B" + "".join(FORMATS[kind_of(name)] for name in names))

    def packed(self, arm: Arm) -> bytes:
        """Return the packet of the current values."""
        outputs = arm.outputs()
        values: list[float] = [self._number]
        for name in self._names:
            head, _, number = name.rpartition("_")
            count = int(FORMATS[kind_of(name)][:-1] or 1)
            if head in arm.registers:
                values.append(arm.registers[head][int(number)])
            elif count == 1:
                values.append(outputs.get(name, 0))
            else:
                values += outputs.get(name, (0,) * count)
        return self._struct.pack(*values)


class Controller:
    """The ports of a controller."""

    def __init__(self, host: str, arm: Arm) -> None:
        self.host, self.arm = host, arm
        self._servers: list[asyncio.Server] = []
        self._writers: set[asyncio.StreamWriter] = set()
        self._inputs: dict[str, asyncio.StreamWriter] = {}  # the only client that may set an input
        self._unplugged_until = 0.0  # monotonic [s]

    async def listen(self) -> None:
        """Open the ports."""
        ports = {RTDE: self._rtde, DASHBOARD: self._dashboard, **dict.fromkeys(SCRIPTS, self._script)}
        for port, serve in ports.items():
            self._servers.append(await asyncio.start_server(self._tracked(serve), self.host, port))

    def _tracked(self, serve: Callable) -> Callable:
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
        """Close all ports for a while, and return without power at the joints."""
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
        """Move the arm until cancelled."""
        due = last = listened = time.monotonic()
        while True:
            now = time.monotonic()
            self.arm.listen(now - listened)
            listened = now
            while last + 1 / RATE <= now:
                self.arm.step(1 / RATE)
                last += 1 / RATE
                await asyncio.sleep(0)  # after a stall, packets arrive between the steps, not all at once
            due = max(due + 1 / RATE, now)
            await asyncio.sleep(due - time.monotonic())

    async def _plugged(self) -> None:
        """Wait until the cable is plugged in."""
        await asyncio.sleep(max(0.0, self._unplugged_until - time.monotonic()))

    async def _rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:  # noqa: PLR0912
        inputs: dict[int, list[str]] = {}
        outputs: dict[int, Recipe] = {}
        sender: asyncio.Task | None = None
        period = 1 / RATE

        def reply(kind: int, payload: bytes) -> None:
            writer.write(struct.pack(">HB", 3 + len(payload), kind) + payload)

        async def send() -> None:
            due = time.monotonic()
            while True:
                await self._plugged()
                for recipe in outputs.values():
                    reply(ord("U"), recipe.packed(self.arm))
                await writer.drain()
                due = max(due + period, time.monotonic())
                await asyncio.sleep(due - time.monotonic())

        try:
            while True:
                size, kind = struct.unpack(">HB", await reader.readexactly(3))
                payload = await reader.readexactly(size - 3)
                await self._plugged()
                match chr(kind):
                    case "V":  # protocol version
                        reply(kind, b"\x01")
                    case "v":  # controller version
                        reply(kind, struct.pack(">4I", *((3, 15, 8, 0) if self.arm.cb3 else (5, 12, 6, 0))))
                    case "O":  # output recipe
                        period = 1 / struct.unpack(">d", payload[:8])[0]
                        names, kinds = variables(payload[8:])
                        number = 0 if "NOT_FOUND" in kinds else len(outputs) + 1
                        if number:
                            outputs[number] = Recipe(number, names)
                        reply(kind, struct.pack(">B", number) + ",".join(kinds).encode())
                    case "I":  # input recipe
                        names, kinds = variables(payload)
                        for n, name in enumerate(names):
                            if self._inputs.setdefault(name, writer) is not writer:
                                kinds[n] = "IN_USE"
                        inputs[len(inputs) + 1] = names
                        reply(kind, struct.pack(">B", len(inputs)) + ",".join(kinds).encode())
                    case "S":  # start
                        reply(kind, b"\x01")
                        sender = sender or asyncio.create_task(send())
                    case "P":  # pause
                        reply(kind, b"\x01")
                        if sender is not None:
                            sender.cancel()
                            sender = None
                    case "U":  # inputs
                        names = inputs[payload[0]]
                        if self._inputs.get(COMMAND) is writer:
                            self.arm.receive()
                        if all(self._inputs.get(name) is writer for name in names):
                            self._set(names, payload[1:])
                            values = self.arm.registers["input_double_register"]
                            self.arm.arrivals.append([time.monotonic(), *values[:6]])
                    case other:
                        raise NotImplementedError(f"packet {other}")
                await writer.drain()
        finally:
            self._inputs = {name: owner for name, owner in self._inputs.items() if owner is not writer}
            if sender is not None:
                sender.cancel()

    def _set(self, names: list[str], payload: bytes) -> None:
        """Set inputs from the payload of a packet."""
        values = struct.unpack(">" + "".join(FORMATS[kind_of(name)] for name in names), payload)
        for name, value in zip(names, values, strict=True):
            head, _, number = name.rpartition("_")
            if head in self.arm.registers:
                self.arm.registers[head][int(number)] = value
            elif name == "speed_slider_fraction":
                self.arm.slider = value
        self.arm.set_outputs(dict(zip(names, values, strict=True)))

    async def _dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            await self._plugged()
            writer.write(self.arm.dashboard(line.decode()).encode() + b"\n")
            await writer.drain()

    async def _script(self, reader: asyncio.StreamReader, _writer: asyncio.StreamWriter) -> None:
        text = b""
        while chunk := await reader.read(65536):
            await self._plugged()
            text += chunk
            if text.rstrip().endswith(b"end"):
                if b"def rtde_control" in text:
                    self.arm.start_program()
                text = b""

    async def orders(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Execute lines of a test; reply with the state of the arm."""
        arm = self.arm
        while line := await reader.readline():
            match line.decode().split():
                case ["protect"]:
                    arm.protect("requested by a test")
                case ["emergency"]:
                    arm.safety, arm.mode = EMERGENCY_STOP, POWER_OFF
                    arm.end_program()
                case ["end"]:
                    arm.end_program()
                case ["normal"]:
                    arm.safety = NORMAL
                case ["forget"]:
                    arm.targets.clear()
                    arm.arrivals.clear()
                case ["input", bit, level]:
                    self.arm.inputs = self.arm.inputs & ~(1 << int(bit)) | int(level) << int(bit)
                case ["analog", number, volts]:
                    self.arm.analog_inputs[int(number)] = float(volts)
                case ["push", *values]:
                    arm.push = tuple(map(float, values))
                case ["slider", share]:
                    arm.slider = float(share)
                case ["pull", seconds]:
                    self._unplugged_until = time.monotonic() + float(seconds)
                case ["reboot", seconds]:
                    self._rebooting = asyncio.create_task(self.reboot(float(seconds)))
            names = ("stops", "commands", "packets", "fastest", "payload", "freedrive")
            state = {name: getattr(arm, name) for name in names}
            if line == b"targets\n":
                state |= {"targets": list(arm.targets), "arrivals": list(arm.arrivals)}
            state |= {"q": arm.q.tolist(), "qd": arm.qd.tolist(), "mode": MODES[arm.mode]}
            writer.write(json.dumps(state).encode() + b"\n")
            await writer.drain()


async def serve(host: str, arm: Arm) -> None:
    """Run until cancelled."""
    controller = Controller(host, arm)
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
    q = np.array([float(x) for x in args.q.split(",")])
    asyncio.run(serve(args.host, Arm(q, args.cb3, POWER_OFF if args.off else RUNNING)))


if __name__ == "__main__":
    main()
