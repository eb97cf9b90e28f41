"""Jogging on the page: the arm moves only while a button is held down.

The page says so each 40 ms (overlay.js); every word becomes one `JogCommand`, and nothing repeats it: when words cease,
for whatever reason, the executor brakes 0.1 s after the last one. A stop, a hold, or another page's word ends it until
the button was let go.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import viser

from common.client.operator_motion import UNREACHABLE
from common.control.jogging import PAUSE
from common.messages import SELF_RELEASING, UNKNOWN_OPERATOR, MotionOwner, MotionStatus
from common.time_source import monotonic
from page.console import Desk
from page.doors import Doors
from page.line import Holder
from page.markup import block, hold, live, text
from page.plots import short_names

UNANSWERED = 1.0  # [s] of asking in vain, after which that is told
OTHERS = 0.5  # [s] after the last word of a page, in which no other one jogs
TOOL_SPEED, TURN_SPEED = 0.25, 1.0  # [m/s] reduced speed of ISO 10218-1, [rad/s], at 100 %
SLOW = 20  # [%] at first
JOINTS = "joints"
FRAMES = {"tool, axes of the base": "base", "tool, its own axes": "tool", "tool, axes of the world": "world"}
AXES = "xyz"

Velocities = Mapping[str, Any]  # fields of a JogCommand


class Jogs(Protocol):
    """Sends velocities for a person: `Console`."""

    doors: Doors  # know who that person is

    def jog(self, acknowledged: int, **velocities: Any) -> None:
        """Move so for a moment; without any come to rest."""


class Jogger(Holder):
    """Turns words of a page into velocities; one page at a time."""

    def __init__(
        self, jogs: Jogs, velocities: Callable[[str], Velocities | None],
        state: Callable[[], tuple[MotionStatus | None, MotionOwner | None]], kept: Callable[[], str],
    ) -> None:
        """Make one.

        Args:
            jogs: sends them.
            velocities: of a button by its name.
            state: what the arm does, and whose the motion is.
            kept: why nobody can move the arm now.
        """
        self._jogs, self._velocities, self._state, self._kept = jogs, velocities, state, kept
        self._who: object = None
        self._press: tuple[object, int] | None = None  # the newest that was begun or refused
        self._at, self._began, self._heard = 0.0, 0.0, 0
        self._taken = False  # whether the arm has moved for this press

    def hold(self, who: object, what: str, press: int, refuse: Callable[[str], None]) -> None:
        """Move the arm for the next 0.1 s as the button says, or tell why not: that press never counts again then."""
        velocities, now = self._velocities(what), monotonic()
        if velocities is None:
            return
        motion, owner = self._state()
        if self._who not in (None, who) and now - self._at < OTHERS:
            refuse("Another page jogs the arm")
            return
        begins = self._press != (who, press)
        if not begins and self._who is None:
            return  # it was refused, or let go
        newest = motion.newest if motion is not None else 0
        why = self._kept() or self._inhibited(motion)
        if not (why or begins) and motion is not None and newest > self._heard:
            why = f"it is {motion.interlocks[-1].description}"
        jogged = owner is not None and owner.jogging and owner.owner == self._jogs.doors.person
        self._taken = jogged or (self._taken and not begins)
        if owner is not None and not (why or begins or jogged) and now - self._began > UNANSWERED:
            if self._taken and owner.kind == "none" and not owner.jogging:
                why = "nothing was heard of the button for a moment (a slow link, or a busy machine): press it again"
            else:
                why = f"{UNREACHABLE}; the motion is {owner.description}"
        if begins:
            self._press, self._began = (who, press), now
            if newest != self._heard:  # the executor wants a pause after a stop: else this press would never count
                self._heard, self._began = newest, now + PAUSE
        if why:
            self.release(who)
            self._who = None
            refuse(f"The arm is not jogged: {why}")
            return
        self._who, self._at = who, now
        if now >= self._began:
            self._jogs.jog(self._heard, **velocities)

    def _inhibited(self, motion: MotionStatus | None) -> str:
        """Who else stopped the arm, in words."""
        ours = (self._jogs.doors.person, UNKNOWN_OPERATOR, *SELF_RELEASING)
        interlocks = motion.interlocks if motion is not None else []
        return "; ".join(f"it is {one.description}" for one in interlocks if one.by not in ours)

    def release(self, who: object) -> None:
        """Have the arm come to rest, if that page moved it."""
        if who is self._who:
            self._who = None
            self._jogs.jog(self._heard)


class JogPanel:
    """What is jogged, how fast, and a pad of buttons to hold down."""

    def __init__(self, gui: viser.GuiApi, desk: Desk, joints: Sequence[str], fastest: Sequence[float]) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            desk: takes what is chosen.
            joints: names, in order.
            fastest: their greatest velocities [rad/s].
        """
        self._joints, self._fastest = list(joints), list(fastest)
        self._mode, self._share = JOINTS, SLOW / 100
        mode = gui.add_dropdown("Jogged", [JOINTS, *FRAMES], initial_value=JOINTS)
        desk.on_change(mode, self._set_mode)
        speed = gui.add_slider("Jog speed [%]", 1, 100, 1, SLOW, hint="100: the tool at 250 mm/s, turning at 1 rad/s, "
                                                                       "or a joint as fast as it may be jogged")
        desk.on_change(speed, self._set_speed)
        self._why = ""
        self._html = gui.add_html(self._pad())

    def show(self, why: str) -> None:
        """Have the buttons off for a reason, or on without one."""
        if why != self._why:
            self._why = why
            self._html.content = self._pad()

    def velocities(self, button: str) -> Velocities | None:
        """What a button of the pad moves, as fields of a `JogCommand`; None for one that there is not."""
        kind, _, rest = button.partition(":")
        name, _, sign = rest.rpartition(":")
        if sign not in ("+", "-"):
            return None
        share = self._share if sign == "+" else -self._share
        if kind == "joint" and name in self._joints:
            return {"joints": {name: share * self._fastest[self._joints.index(name)]}}
        frame, _, axis = name.rpartition(":")
        if frame not in FRAMES.values() or len(axis) != 1 or axis not in AXES or kind not in ("move", "turn"):
            return None
        field, fastest = ("linear", TOOL_SPEED) if kind == "move" else ("angular", TURN_SPEED)
        return {"frame": frame, field: {axis: share * fastest}}

    def _pad(self) -> str:
        if self._mode == JOINTS:
            rows = [self._row(short, f"joint:{name}", _said(short), f"j:{name}")
                    for name, short in zip(self._joints, short_names(self._joints), strict=True)]
        else:
            frame = FRAMES[self._mode]
            rows = [self._row(axis.upper(), f"move:{frame}:{axis}", f"tool along {axis}", f"p:{axis}") for axis in AXES]
            rows += [self._row(f"about {axis.upper()}", f"turn:{frame}:{axis}", f"turn the tool about {axis}",
                               f"r:{axis}") for axis in AXES]
        note = self._why or "Moves while a button is held down. Nothing looks for obstacles."
        return block(f'<div class="dim small">{text(note)}</div><div class="pad">{"".join(rows)}</div>', "jog")

    def _row(self, label: str, name: str, told: str, number: str) -> str:
        less = hold("−", f"{name}:-", f"jog {told}, minus", self._why)
        more = hold("+", f"{name}:+", f"jog {told}, plus", self._why)
        return f'<div><span class="name">{text(label)}</span>{live(number)}{less}{more}</div>'

    def _set_mode(self, mode: str) -> None:
        self._mode = mode
        self._html.content = self._pad()

    def _set_speed(self, percent: float) -> None:
        self._share = min(max(percent, 1.0), 100.0) / 100


def _said(short: str) -> str:
    """What a screen reader calls a joint: as it is written beside its buttons, with the word once."""
    return short if "joint" in short.lower() else f"joint {short}"
