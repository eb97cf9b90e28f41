"""Simulated arm of a controller of Universal Robots: joints, modes, registers, and the dashboard's commands.

Joints follow `servoj` with the requested lookahead; of the program that `ur_rtde` uploads, the arm knows the commands
that move and stop it and set its payload.
"""

import sys
from collections import deque
from dataclasses import dataclass, field

import numpy as np

POWER_OFF, IDLE, RUNNING = 3, 5, 7  # robot modes
NORMAL, PROTECTIVE_STOP, EMERGENCY_STOP = 1, 3, 7  # safety modes
MODES = {POWER_OFF: "POWER_OFF", IDLE: "IDLE", RUNNING: "RUNNING"}
SAFETY = {NORMAL: "NORMAL", PROTECTIVE_STOP: "PROTECTIVE_STOP", EMERGENCY_STOP: "ROBOT_EMERGENCY_STOP"}
SPEED, ACCELERATION = 3.3, 60.0  # of a joint; a protective stop follows beyond [rad/s], [rad/s^2]
# Commands in the first input register, as ur_rtde 1.6 sends them.
SERVOJ, SPEED_STOP, SERVO_STOP, PAYLOAD, TEACH, END_TEACH, WATCHDOG, STOP_SCRIPT = 11, 15, 16, 17, 18, 19, 35, 255
LONGEST_TURN = 0.02  # [s]


@dataclass
class Arm:
    """Joints, modes and registers; `step` is one cycle of the controller."""

    q: np.ndarray
    cb3: bool = False
    mode: int = RUNNING
    safety: int = NORMAL
    slider: float = 1.0
    program: bool = False
    freedrive: bool = False
    payload: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    push: tuple[float, ...] = (0.0,) * 6  # wrench of the force sensor, in base axes
    registers: dict[str, list[float]] = field(default_factory=lambda: {
        f"{way}_{kind}_register": [0] * 48 for way in ("input", "output") for kind in ("int", "double")})
    inputs: int = 0  # digital, one bit each
    digital_outputs: int = 0
    analog_inputs: list[float] = field(default_factory=lambda: [0.0, 0.0])  # [V]
    analog_outputs: list[float] = field(default_factory=lambda: [0.0, 0.0])
    stops: int = 0  # protective ones
    commands: int = 0  # steps with a servoj command
    packets: int = 0  # from the client that sends commands
    fastest: float = 0.0  # highest speed of a joint [rad/s]
    time: float = 0.0  # [s] of its clock
    targets: deque[list[float]] = field(default_factory=lambda: deque(maxlen=4000))  # of its newest cycles
    arrivals: deque[list[float]] = field(default_factory=lambda: deque(maxlen=4000))  # time, target

    def __post_init__(self) -> None:
        """Start at standstill."""
        self.qd = np.zeros(6)
        self.target = self.q.copy()
        self._lookahead = 0.03
        self._servoing = False
        self._silence = 0.0  # [s] since the last packet
        self._timeout = 0.0  # [s] of silence that ends a program with a watchdog

    def step(self, seconds: float) -> None:
        """Execute the command in the registers, and move the joints."""
        self.time += seconds
        if self.program:
            self._execute(int(self.registers["input_int_register"][0]))
        able = self.mode == RUNNING and self.safety == NORMAL
        if able and self.program and 0 < self._timeout < self._silence:
            sys.stderr.write(f"watchdog: no packet for {self._silence:.2f} s\n")
            self.end_program()
        servoing = able and self.program and self._servoing
        self.targets.append(self.target.tolist())
        off = self.target - self.q if servoing else 0.0 * self.q
        wanted = off / max(self._lookahead, 2 * seconds) * self.slider
        change = (wanted - self.qd) / seconds
        if servoing and (np.any(np.abs(wanted) > SPEED) or np.any(np.abs(change) > 10 * ACCELERATION)):
            self.protect(f"joints would move at {np.abs(wanted).max():.2f} rad/s, {np.abs(change).max():.0f} rad/s^2")
            return
        allowed = ACCELERATION * seconds
        self.qd = self.qd + np.clip(wanted - self.qd, -allowed, allowed)
        self.fastest = max(self.fastest, float(np.abs(self.qd).max()))
        self.q = self.q + self.qd * seconds

    def _execute(self, command: int) -> None:
        values, reply = self.registers["input_double_register"], self.registers["output_int_register"]
        if command == 0:
            reply[0] = 1  # ready
            return
        if command == SERVOJ:
            self.target, self._lookahead = np.array(values[:6]), values[9]
            self._servoing, self.commands, reply[0] = True, self.commands + 1, 1
            return  # a stream of commands is not acknowledged
        if reply[0] == 1:
            if command in (SPEED_STOP, SERVO_STOP):
                self._servoing = False
            elif command == PAYLOAD:
                self.payload = tuple(values[:4])
            elif command in (TEACH, END_TEACH):
                self.freedrive = command == TEACH
            elif command == STOP_SCRIPT:
                self.end_program()
            elif command == WATCHDOG and values[0] > 0:
                self._timeout = 1.0 / values[0]
        reply[0] = 2  # done

    def listen(self, seconds: float) -> None:
        """Count time in which packets could arrive; a stalled machine is no silence."""
        self._silence += min(seconds, LONGEST_TURN)

    def receive(self) -> None:
        """Count a packet of commands, and reset the watchdog."""
        self._silence, self.packets = 0.0, self.packets + 1

    def start_program(self) -> None:
        """Run the uploaded program, if the arm can."""
        if self.mode == RUNNING and self.safety == NORMAL:
            self.program, self.freedrive, self._servoing, self._timeout = True, False, False, 0.0
            self.registers["output_int_register"][0] = 1
            self._silence = 0.0

    def end_program(self) -> None:
        """Brake; the next motion needs a new upload."""
        self.program, self.freedrive, self._servoing = False, False, False
        self.registers["output_int_register"][0] = 0

    def protect(self, reason: str) -> None:
        """Do a protective stop."""
        self.safety, self.stops = PROTECTIVE_STOP, self.stops + 1
        self.end_program()
        sys.stderr.write(f"protective stop: {reason}\n")

    def set_outputs(self, values: dict[str, float]) -> None:
        """Set the digital and analog outputs that the masks of a packet select."""
        for bank, first in (("standard", 0), ("configurable", 8), ("tool", 16)):
            mask = int(values.get(f"{bank}_digital_output_mask", 0)) << first
            bits = int(values.get(f"{bank}_digital_output", 0)) << first
            self.digital_outputs = self.digital_outputs & ~mask | bits & mask
        for number in (0, 1):
            if int(values.get("standard_analog_output_mask", 0)) >> number & 1:
                self.analog_outputs[number] = 10.0 * values[f"standard_analog_output_{number}"]  # [V]

    def outputs(self) -> dict[str, object]:
        """Return the outputs that are not 0, except registers."""
        powered = self.mode in (IDLE, RUNNING)
        q, qd = self.q.tolist(), self.qd.tolist()
        return {
            "timestamp": self.time, "actual_q": q, "actual_qd": qd, "target_q": q,
            "target_qd": qd, "robot_mode": self.mode, "safety_mode": self.safety, "safety_status": self.safety,
            "runtime_state": 2 if self.program else 1, "robot_status_bits": powered | (self.program << 1),
            "safety_status_bits": {PROTECTIVE_STOP: 4, EMERGENCY_STOP: 0xC0}.get(self.safety, 1),
            "speed_scaling": self.slider, "target_speed_fraction": self.slider, "payload": self.payload[0],
            "payload_cog": self.payload[1:], "actual_TCP_force": self.push,
            "joint_mode": (253 if self.mode == RUNNING else 239,) * 6,
            "actual_digital_input_bits": self.inputs, "actual_digital_output_bits": self.digital_outputs,
            "standard_analog_input0": self.analog_inputs[0], "standard_analog_input1": self.analog_inputs[1],
            "standard_analog_output0": self.analog_outputs[0], "standard_analog_output1": self.analog_outputs[1],
            "actual_main_voltage": 48.0, "actual_robot_voltage": 48.0,
        }

    def dashboard(self, line: str) -> str:
        """Execute a line of the dashboard, and return its reply."""
        command = line.strip().lower()
        if command == "power on":
            self.mode = max(self.mode, IDLE)
        elif command == "brake release":
            self.mode = RUNNING
        elif command == "unlock protective stop" and self.safety == PROTECTIVE_STOP:
            self.safety = NORMAL
        elif command in ("power off", "stop"):
            self.mode = POWER_OFF if command == "power off" else self.mode
            self.end_program()
        return {
            "polyscopeversion": f"URSoftware {'3.15.8.106339' if self.cb3 else '5.12.6.1102099'} (Sep 21 2023)",
            "robotmode": f"Robotmode: {MODES[self.mode]}", "safetymode": f"Safetymode: {SAFETY[self.safety]}",
            "safetystatus": f"Safetystatus: {SAFETY[self.safety]}", "is in remote control": "true",
            "running": f"Program running: {str(self.program).lower()}", "get robot model": "UR5",
            "programstate": "PLAYING rtde_control" if self.program else "STOPPED rtde_control",
            "get serial number": "20195500001", "power on": "Powering on", "power off": "Powering off",
            "brake release": "Brake releasing", "unlock protective stop": "Protective stop releasing",
            "close safety popup": "closing safety popup", "stop": "Stopped", "quit": "Disconnected",
        }.get(command, f"could not understand: '{command}'")
