"""A 3D mouse of 3Dconnexion: pushing and turning its cap moves the arm, releasing it stops the arm.

By kernel and model its axes are relative or absolute. Relative ones repeat while the cap is deflected and then cease,
so each value counts for `HELD`. Absolute ones report their return to 0.
"""

from __future__ import annotations

from typing import Any

from tools.teleoperation.devices import REST, Action, Axes, Reading
from tools.teleoperation.gamepad import SILENCE, with_dead_zone
from tools.teleoperation.input_events import EV_ABS, EV_KEY, EV_REL, EV_SYN, SYN_DROPPED, EventSource, Range, open_input

VENDORS = (0x256F, 0x046D)  # 3Dconnexion, and Logitech, which sold them before
LOGITECH_NAMES = ("Space", "3Dconnexion")
AXES = range(6)  # codes x, y, z, rx, ry, rz of relative and absolute events: right, towards the operator, down
FULL = Range(-350, 350)  # of relative axes, and of absolute ones by their makers' documents
ACTIONS: dict[int, Action] = {0x100: "gripper", 0x101: "stop"}  # BTN_0, BTN_1
DEAD_ZONE = 0.12  # share of the range that requests rest: one hand does not push exactly along an axis
HELD = 0.1  # [s] that a relative value counts


class SpaceMouse:
    """The cap as velocities, and the buttons as actions."""

    help = "push and turn the cap to move; left button: gripper, right button: STOP"

    def __init__(self, source: EventSource) -> None:
        """Read a device."""
        self._source = source
        self._values: dict[int, tuple[float, float]] = {}  # share, and until when it counts [s]

    @classmethod
    def open(cls, path: str | None) -> SpaceMouse:
        """Return the 3D mouse at a path, or the first one of this host.

        Raises:
            ConfigError: there is none, or evdev is not installed.
        """
        return cls(open_input("spacemouse", path, is_spacemouse))

    def read(self, now: float) -> Reading:
        """Return the state at a monotonic time [s].

        Raises:
            DeviceLost: it was unplugged.
        """
        actions = list[Action]()
        for kind, code, value in self._source.read():
            if kind == EV_KEY and value == 1 and code in ACTIONS:
                actions.append(ACTIONS[code])
            elif kind in (EV_REL, EV_ABS) and code in AXES:
                share = self._source.ranges.get(code, FULL).share(value) if kind == EV_ABS else FULL.share(value)
                self._values[code] = (with_dead_zone(share, DEAD_ZONE), now + (HELD if kind == EV_REL else SILENCE))
            elif (kind, code) == (EV_SYN, SYN_DROPPED):
                self._values = {}
        return Reading(self._axes(now), tuple(actions))

    def _axes(self, now: float) -> Axes:
        right, near, down, pitch, roll, yaw = (
            share if now < until else 0.0 for share, until in (self._values.get(code, (0.0, 0.0)) for code in AXES))
        found = (-near, -right, -down, -roll, -pitch, -yaw)
        return found if any(found) else REST


def is_spacemouse(device: Any) -> bool:
    """Return whether an `evdev.InputDevice` is a 3D mouse."""
    by_logitech = any(name in device.name for name in LOGITECH_NAMES)
    return device.info.vendor == VENDORS[0] or (device.info.vendor == VENDORS[1] and by_logitech)
