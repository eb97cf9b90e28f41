"""Velocities by the keys of a terminal, which reports presses and repeats, but no release.

So a key counts for a bounded time: the first press moves the arm for `STEP`, a repeated one for `HELD`. A key that is
held down starts with a step, and continues as soon as the keyboard repeats it.
"""

from __future__ import annotations

from tools.teleoperation.devices import REST, Action, Axes, Reading

STEP = 0.12  # [s] that the first press of a key counts
HELD = 0.15  # [s] that a repeated press counts: keyboards repeat at 25 to 30 Hz
REPEAT_WITHIN = 0.8  # [s] after a press, in which another one of the same key is a repetition

MOTIONS: dict[str, Axes] = {
    "w": (1, 0, 0, 0, 0, 0), "s": (-1, 0, 0, 0, 0, 0), "a": (0, 1, 0, 0, 0, 0), "d": (0, -1, 0, 0, 0, 0),
    "r": (0, 0, 1, 0, 0, 0), "f": (0, 0, -1, 0, 0, 0), "u": (0, 0, 0, 1, 0, 0), "o": (0, 0, 0, -1, 0, 0),
    "k": (0, 0, 0, 0, 1, 0), "i": (0, 0, 0, 0, -1, 0), "j": (0, 0, 0, 0, 0, 1), "l": (0, 0, 0, 0, 0, -1),
}
ACTIONS: dict[str, Action] = {
    "g": "gripper", "space": "stop", "h": "home", "p": "control", "+": "faster", "=": "faster", "-": "slower",
    "t": "frame", "q": "quit", "n": "start", "\n": "start", "\r": "start", "y": "success", "x": "failure",
    "z": "discard", "\x7f": "discard",
}


class Keyboard:
    """Keys of the terminal as velocities, if `moves`, and as actions."""

    help = ("w s a d r f: move, u o i k j l: rotate, g: gripper, space: STOP, h: home, + -: speed, t: frame, "
            "p: take over, q: quit")

    def __init__(self, *, moves: bool = True) -> None:
        """Start with no key pressed; without `moves` another device moves the arm."""
        self._moves = moves
        self._key, self._pressed_at, self._until = "", 0.0, 0.0
        self._actions = list[Action]()

    def press(self, key: str, now: float) -> None:
        """Take a key, by its name in `recording.keyboard`, at a monotonic time [s]."""
        key = key.lower() if len(key) == 1 else key
        if key in MOTIONS and self._moves:
            repeated = key == self._key and now - self._pressed_at < REPEAT_WITHIN
            self._key, self._pressed_at = key, now
            self._until = now + (HELD if repeated else STEP)
        else:
            self._key, self._until = "", 0.0  # any other key ends the motion
            if action := ACTIONS.get(key):
                self._actions.append(action)

    def read(self, now: float) -> Reading:
        """Return the state at a monotonic time [s]."""
        actions, self._actions = tuple(self._actions), []
        return Reading(MOTIONS[self._key] if now < self._until else REST, actions)
