"""A gamepad with two sticks: it moves the arm only while the dead-man button is held."""

from __future__ import annotations

from typing import Any

from tools.teleoperation.devices import REST, Action, Axes, Reading
from tools.teleoperation.input_events import EV_ABS, EV_KEY, EV_SYN, SYN_DROPPED, EventSource, open_input

BTN_SOUTH, BTN_EAST, BTN_NORTH, BTN_WEST, BTN_TL, BTN_TR, BTN_SELECT, BTN_START, BTN_MODE = (
    304, 305, 307, 308, 310, 311, 314, 315, 316)
ABS_X, ABS_Y, ABS_RX, ABS_RY, ABS_HAT0X, ABS_HAT0Y = 0, 1, 3, 4, 16, 17
DEAD_MAN = BTN_TL
ACTIONS: dict[int, Action] = {
    BTN_SOUTH: "gripper", BTN_EAST: "stop", BTN_NORTH: "success", BTN_WEST: "failure", BTN_TR: "frame",
    BTN_SELECT: "discard", BTN_START: "start", BTN_MODE: "control",
}
DEAD_ZONE = 0.15  # share of a stick's range about its middle that requests rest
SILENCE = 3.0  # [s] without an event, after which it requests no motion: its radio link may be lost


class Gamepad:
    """Sticks and buttons as velocities and actions."""

    help = ("hold LB (left bumper) to move; left stick: x y, right stick: z and yaw, hat: roll and pitch, A: gripper, "
            "B: STOP, RB: frame, logo: take over")

    def __init__(self, source: EventSource) -> None:
        """Read a device; nothing counts as held that was held before."""
        self._source = source
        self._values: dict[int, float] = {}
        self._held, self._last = False, float("-inf")

    @classmethod
    def open(cls, path: str | None) -> Gamepad:
        """Return the gamepad at a path, or the first one of this host.

        Raises:
            ConfigError: there is none, or evdev is not installed.
        """
        return cls(open_input("gamepad", path, is_gamepad))

    def read(self, now: float) -> Reading:
        """Return the state at a monotonic time [s].

        Raises:
            DeviceLost: it was unplugged.
        """
        actions = list[Action]()
        for kind, code, value in self._source.read():
            self._last = now
            if kind == EV_KEY and code == DEAD_MAN:
                self._held = value != 0
            elif kind == EV_KEY and value == 1 and code in ACTIONS:
                actions.append(ACTIONS[code])
            elif kind == EV_ABS and code in self._source.ranges:
                self._values[code] = with_dead_zone(self._source.ranges[code].share(value))
            elif (kind, code) == (EV_SYN, SYN_DROPPED):
                self._held, self._values = False, {}
        moves = self._held and now - self._last < SILENCE
        return Reading(self._axes() if moves else REST, tuple(actions))

    def _axes(self) -> Axes:
        x, y, rx, ry, hat_x, hat_y = (
            self._values.get(code, 0.0) for code in (ABS_X, ABS_Y, ABS_RX, ABS_RY, ABS_HAT0X, ABS_HAT0Y))
        return (-y, -x, -ry, hat_x, -hat_y, -rx)  # sticks count to the right and down


def with_dead_zone(share: float, zone: float = DEAD_ZONE) -> float:
    """Return a share -1 to 1 that is 0 inside the zone, and continuous at its end."""
    size = max(abs(share) - zone, 0.0) / (1 - zone)
    return min(size, 1.0) * (1 if share > 0 else -1)


def is_gamepad(device: Any) -> bool:
    """Return whether an `evdev.InputDevice` has the buttons and sticks of a gamepad."""
    found = device.capabilities(absinfo=False)
    return BTN_SOUTH in found.get(EV_KEY, []) and ABS_X in found.get(EV_ABS, [])
