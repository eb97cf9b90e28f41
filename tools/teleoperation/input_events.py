"""Input devices of Linux: which there are, and their events, by evdev (extras `gamepad` and `spacemouse`)."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from common.errors import ConfigError
from tools.teleoperation.devices import DeviceLost

# Of linux/input-event-codes.h.
EV_SYN, EV_KEY, EV_REL, EV_ABS = 0, 1, 2, 3
SYN_DROPPED = 3  # the kernel has discarded events: the state of all buttons and axes is unknown


class Event(NamedTuple):
    """One event: type, code and value as the kernel defines them."""

    type: int
    code: int
    value: int


@dataclass(frozen=True)
class Range:
    """Values of an absolute axis."""

    low: int
    high: int

    def share(self, value: int) -> float:
        """Return a value as a share -1 to 1 of the range about its middle."""
        return (2 * value - self.low - self.high) / max(self.high - self.low, 1)


class EventSource(Protocol):
    """An open input device."""

    @property
    def ranges(self) -> Mapping[int, Range]:
        """Values of the absolute axes, by code."""

    def read(self) -> Iterable[Event]:
        """Return the events since the last call; never blocks.

        Raises:
            DeviceLost: the device is gone.
        """


class InputDevice:
    """An input device of this host."""

    def __init__(self, device: Any) -> None:
        """Read an `evdev.InputDevice`."""
        self._device, self.name = device, str(device.name)
        axes = device.capabilities(absinfo=True).get(EV_ABS, [])
        self.ranges: Mapping[int, Range] = {code: Range(about.min, about.max) for code, about in axes}

    def read(self) -> list[Event]:
        """Return the events since the last call.

        Raises:
            DeviceLost: it was unplugged.
        """
        try:
            return [Event(each.type, each.code, each.value) for each in self._device.read()]
        except BlockingIOError:
            return []
        except OSError as error:
            raise DeviceLost(self.name, error.strerror or str(error)) from None


def open_input(kind: str, path: str | None, fits: Callable[[Any], bool]) -> InputDevice:
    """Return the device at a path, or the first one that `fits` an `evdev.InputDevice`.

    Raises:
        ConfigError: evdev is not installed, or there is no such device.
    """
    try:
        evdev = importlib.import_module("evdev")
    except ImportError as error:
        advice = f"needs the extra `{kind}`: pip install 'zencell[{kind}]'"
        raise ConfigError("--with", kind, f"{advice} ({error})") from None
    if path is not None:
        try:
            return InputDevice(evdev.InputDevice(path))
        except OSError as error:
            raise ConfigError("--device", path, f"cannot be opened: {error.strerror or error}") from None
    devices = [evdev.InputDevice(each) for each in evdev.list_devices()]
    for device in devices:
        if fits(device):
            return InputDevice(device)
    there = ", ".join(f"{device.path} ({device.name})" for device in devices)
    raise ConfigError("--with", kind, f"was not found; readable input devices: {there or 'none'}. A user needs access "
                                      "to /dev/input/event*, as members of the group `input` have")
