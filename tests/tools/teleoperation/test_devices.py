"""Keys, recorded events of a gamepad and of 3D mice, as velocities and actions; a device that is unplugged."""

import errno
import os
from types import SimpleNamespace

import pytest

from common.errors import ConfigError
from tools.teleoperation import input_events
from tools.teleoperation.devices import REST, DeviceLost, Reading
from tools.teleoperation.gamepad import Gamepad, is_gamepad
from tools.teleoperation.input_events import EV_ABS, EV_KEY, EV_REL, EV_SYN, Event, InputDevice, Range, open_input
from tools.teleoperation.keyboard import HELD, STEP, Keyboard
from tools.teleoperation.spacemouse import SpaceMouse, is_spacemouse

FORWARD, LEFT, UP = (1, 0, 0, 0, 0, 0), (0, 1, 0, 0, 0, 0), (0, 0, 1, 0, 0, 0)
SYN = Event(EV_SYN, 0, 0)


# --- keyboard ---


def test_tapped_key_moves_for_a_step_only():
    keys = Keyboard()
    keys.press("w", 10.0)
    assert [keys.read(10.0 + t).axes for t in (0.0, STEP - 0.01, STEP + 0.01, 5.0)] == [FORWARD, FORWARD, REST, REST]


def test_held_key_moves_from_its_first_repetition_until_it_ceases():
    keys = Keyboard()
    presses = [0.0, *(0.5 + 0.04 * n for n in range(25))]  # a keyboard waits half a second before it repeats
    moving = []
    for at in presses:
        keys.press("a", at)
        moving.append(keys.read(at + 0.039).axes)
    assert set(moving) == {LEFT}
    assert keys.read(presses[-1] + HELD - 0.01).axes == LEFT and keys.read(presses[-1] + HELD + 0.01).axes == REST


@pytest.mark.parametrize("key", ["space", "g", "?", "s"])
def test_another_key_ends_the_motion_at_once(key):
    keys = Keyboard()
    keys.press("w", 0.0)
    keys.press("w", 0.1)
    keys.press(key, 0.12)
    assert keys.read(0.13).axes[0] in (0, -1)


def test_keys_are_actions_once_and_do_not_move_with_another_device():
    keys = Keyboard(moves=False)
    for key in ("w", "space", "G", "\n", "y"):
        keys.press(key, 0.0)
    assert keys.read(0.0) == Reading(REST, ("stop", "gripper", "start", "success"))
    assert keys.read(0.0).actions == ()


# --- recorded events ---


class Recorded:
    """Events of a device, a list for each reading; the device is gone after the last one."""

    def __init__(self, *readings, ranges=None):
        self.readings, self.ranges = list(readings), ranges or {}

    def read(self):
        if not self.readings:
            raise DeviceLost("pad", "No such device")
        return self.readings.pop(0)


STICKS = {code: Range(-32768, 32767) for code in (0, 1, 3, 4)} | {16: Range(-1, 1), 17: Range(-1, 1)}
LB = 310


def gamepad(*readings):
    return Gamepad(Recorded(*readings, ranges=STICKS))


@pytest.mark.parametrize("code, value, axes", [
    (1, -32768, FORWARD), (0, -32768, LEFT), (4, -32768, UP), (3, -32768, (0, 0, 0, 0, 0, 1)),
    (16, 1, (0, 0, 0, 1, 0, 0)), (17, -1, (0, 0, 0, 0, 1, 0)), (1, 3000, REST), (2, 255, REST), (1, 128, REST),
])
def test_stick_moves_while_the_dead_man_button_is_held(code, value, axes):
    stick = [Event(EV_ABS, code, value), SYN]
    pad = gamepad(stick, [Event(EV_KEY, LB, 1), SYN], [], [Event(EV_KEY, LB, 0), SYN], stick)
    found = [pad.read(0.1 * n).axes for n in range(5)]
    assert found[0] == found[3] == found[4] == REST
    assert found[1] == found[2] == pytest.approx(axes)


def test_gamepad_without_events_or_with_lost_ones_requests_no_motion():
    held = [Event(EV_KEY, LB, 1), Event(EV_ABS, 1, -32768), SYN]
    pad = gamepad(held, [], [Event(EV_ABS, 1, -30000)], [Event(EV_SYN, 3, 0)], [Event(EV_ABS, 1, -32768)])
    assert pad.read(0.0).axes == FORWARD and pad.read(3.1).axes == REST
    assert pad.read(3.2).axes[0] > 0.8 and pad.read(3.3).axes == REST and pad.read(3.4).axes == REST


def test_buttons_are_actions_when_pressed_not_when_released_or_repeated():
    pad = gamepad([Event(EV_KEY, 305, 1)], [Event(EV_KEY, 305, 2)], [Event(EV_KEY, 305, 0)],
                  [Event(EV_KEY, 304, 1), Event(EV_KEY, 315, 1)])
    assert [pad.read(0.0).actions for _ in range(4)] == [("stop",), (), (), ("gripper", "start")]


@pytest.mark.parametrize("kind", [EV_REL, EV_ABS])
@pytest.mark.parametrize("code, value, axis, sign", [
    (0, 350, 1, -1), (1, -350, 0, 1), (2, -350, 2, 1), (3, -350, 4, 1), (4, 350, 3, -1), (5, -350, 5, 1)])
def test_cap_of_a_3d_mouse_moves_until_it_is_released(kind, code, value, axis, sign):
    released = [] if kind == EV_REL else [Event(EV_ABS, code, 0)]  # relative axes only cease
    mouse = SpaceMouse(Recorded([Event(kind, code, value)], [Event(kind, code, value)], [], released, []))
    found = [mouse.read(at).axes for at in (0.0, 0.05, 0.1, 0.2, 0.5)]
    assert found[0] == found[1] == found[2] == tuple(sign if n == axis else 0 for n in range(6))
    assert found[3] == found[4] == REST


def test_slight_deflection_of_the_cap_moves_nothing_and_buttons_are_actions():
    mouse = SpaceMouse(Recorded([Event(EV_REL, 0, 30), Event(EV_KEY, 0x101, 1), Event(EV_KEY, 0x100, 1)]))
    assert mouse.read(0.0) == Reading(REST, ("stop", "gripper"))


# --- devices of the host ---


class FakeDevice:
    """An `evdev.InputDevice` whose reading fails with an error number."""

    def __init__(self, number, name="Xbox Wireless Controller", vendor=0x45E):
        self.number, self.name, self.path, self.info = number, name, "/dev/input/event5", SimpleNamespace(vendor=vendor)

    def capabilities(self, absinfo=True):
        about = SimpleNamespace(min=-10, max=10)
        return {EV_KEY: [304, LB], EV_ABS: [(0, about), (1, about)] if absinfo else [0, 1]}

    def read(self):
        raise OSError(self.number, os.strerror(self.number))


def test_unplugged_device_is_reported_in_one_line():
    with pytest.raises(DeviceLost, match=r"^Xbox Wireless Controller is gone \(No such device\): the arm was stopped$"):
        InputDevice(FakeDevice(errno.ENODEV)).read()
    quiet = InputDevice(FakeDevice(errno.EAGAIN))
    assert quiet.read() == [] and quiet.ranges == {0: Range(-10, 10), 1: Range(-10, 10)}


def test_device_is_found_by_its_kind(monkeypatch):
    there = {"/dev/input/event5": FakeDevice(errno.EAGAIN),
             "/dev/input/event6": FakeDevice(errno.EAGAIN, "3Dconnexion SpaceMouse", 0x256F)}
    evdev = SimpleNamespace(list_devices=lambda: list(there), InputDevice=there.__getitem__)
    monkeypatch.setattr(input_events.importlib, "import_module", lambda name: evdev)
    assert open_input("gamepad", None, is_gamepad).name == "Xbox Wireless Controller"
    assert open_input("spacemouse", None, is_spacemouse).name == "3Dconnexion SpaceMouse"
    there.pop("/dev/input/event6")
    with pytest.raises(ConfigError, match="was not found; readable input devices: /dev/input/event5"):
        open_input("spacemouse", None, is_spacemouse)


def test_missing_extra_is_named(monkeypatch):
    def missing(name):
        raise ImportError("No module named 'evdev'")

    monkeypatch.setattr(input_events.importlib, "import_module", missing)
    with pytest.raises(ConfigError, match=r"needs the extra `gamepad`: pip install 'zencell\[gamepad\]'"):
        open_input("gamepad", None, is_gamepad)
