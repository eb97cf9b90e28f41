"""Jogging: velocities of joints or tool that a person keeps asking for. When they cease, the arm comes to rest.

The arm brakes `DEADMAN` after the newest command and stands `STANDS` later, so it is moved no faster than that allows.
A stream of commands that was refused or interrupted counts again after a pause: who kept a button pressed over a stop
must let go of it first.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.messages import JogCommand

DEADMAN = 0.1  # [s] wall, after the newest command
STANDS = 0.1  # [s] after that: both together are what is promised
PAUSE = 0.3  # [s] wall without a command, after one that was refused
TOOL_SPEED = 0.25  # [m/s] of the TCP at most: the reduced speed of ISO 10218-1 for what is moved by hand
ROOM = 0.5  # share of the acceleration that is reckoned with before the end of a joint,
SETTLE = 0.15  # [s] which is come to the slower the nearer it is, in this time
DAMPING = 0.05  # of the least squares, where the tool loses a direction
NEAR = 0.02  # [m, rad per rad] least singular value of the Jacobian below which it is damped
MOST_REFUSED = 16  # who is remembered for it; with more at once nobody new is heard
TURNED = 0.3  # share of what is asked for by which the tool may leave its direction, where it goes slowest:
SLOWEST = 0.2  # share of the speed with which it still goes on there, and gets out again


class ToolKinematics(Protocol):
    """What is asked of the robot's model."""

    def fk(self, q: Vector) -> NDArray[np.float64]:
        """(4, 4) T_world_tcp at q (dof,) [rad]."""

    def jacobian(self, q: Vector) -> NDArray[np.float64]:
        """(6, dof): what joint velocities move the TCP by, linear then angular, along the axes of world."""

    @property
    def base_axes(self) -> NDArray[np.float64]:
        """(3, 3) axes of the base in world."""


def braked_within(seconds: float, limits: Limits) -> Vector:
    """Velocities (dof,) [rad/s] from which joints come to rest in that time, from no acceleration to none.

    At a jerk j up to a deceleration a: v = a (t - a/j), and j t^2 / 4 where a is not reached.
    """
    a, j = limits.braking, limits.jerks
    return np.where(a / j >= seconds / 2, j * seconds**2 / 4, a * (seconds - a / j))


def room_velocity(room: Vector, limits: Limits) -> Vector:
    """Velocities (dof,) [rad/s] at which joints may go with so much room [rad] before their ends."""
    left = np.maximum(room, 0.0)
    return np.minimum(np.sqrt(2 * ROOM * limits.acceleration * left), left / SETTLE)


class Jogging:
    """What is asked for now, and the joint velocities that come of it."""

    def __init__(self, limits: Limits, kinematics: ToolKinematics | None) -> None:
        """Jog an arm with these limits; without kinematics by its joints only."""
        self._limits, self._kinematics = limits, kinematics
        self._fastest = np.minimum(limits.velocity, braked_within(STANDS, limits))
        self._asked: JogCommand | None = None
        self._at = 0.0  # [s] wall: when that came
        self._began: float | None = None  # [s] wall: what comes soon after may be a stream of before
        self._refused: OrderedDict[str, float] = OrderedDict()  # whose commands do not count, and when the last came

    @property
    def owner(self) -> str:
        """Who jogs; empty while nobody does."""
        return self._asked.owner if self._asked else ""

    def ask(self, request: JogCommand, now: float, objection: Refused | None = None) -> None:
        """Move the arm from now on as is asked for, at wall time [s], unless there is an objection.

        Raises:
            Refused: with the reason.
        """
        before = self._refused.get(request.owner)
        try:
            early = self._began is None or now - self._began < PAUSE
            crowded = len(self._refused) >= MOST_REFUSED and request.owner != self.owner
            if early or crowded or (before is not None and now - before < PAUSE):
                raise Refused("let_go", f"jogging was ended: nothing for {PAUSE:g} s, then it counts again")
            if objection is not None:
                raise objection
            if self._asked is not None and self._asked.owner != request.owner:
                raise Refused("busy", f"{self._asked.owner} jogs the arm")
            self._require_known(request)
        except Refused:
            self._bar(request.owner, now)
            raise
        self._refused.pop(request.owner, None)
        self._asked, self._at = request, now

    def interrupt(self, now: float) -> None:
        """Come to rest, whatever is asked for: who jogs has to let go first; wall time [s]."""
        if self._asked is not None:
            self._bar(self._asked.owner, now)
            self._asked = None

    def velocity(self, q: Vector, now: float, share: float) -> Vector | None:
        """Joint velocities (dof,) [rad/s] to go at from q (dof,) [rad], or None: come to rest.

        Args:
            q: newest set-point.
            now: wall time [s].
            share: of the joints' velocities that is to be had, 0 to 1.
        """
        self._began = now if self._began is None else self._began
        while self._refused and now - next(iter(self._refused.values())) >= PAUSE:
            self._refused.popitem(last=False)
        asked = self._asked
        if asked is None:
            return None
        if now - self._at > DEADMAN:
            self._asked = None
            return None
        limits = self._limits
        lowest, highest = -room_velocity(q - limits.lower, limits), room_velocity(limits.upper - q, limits)
        if asked.joints:
            dq = np.clip([asked.joints.get(name, 0.0) for name in limits.names], lowest, highest)
        else:
            dq = self._by_tool(asked, q)
            with np.errstate(divide="ignore", invalid="ignore"):  # the tool keeps its way: the slowest joint counts
                room = np.where(dq < 0, lowest, highest) / dq
            dq = dq * min(float(np.min(room, where=dq != 0, initial=1.0)), 1.0)
        if not dq.any():
            return None
        dq = dq / max(float((np.abs(dq) / np.minimum(self._fastest, share * limits.velocity)).max()), 1.0)
        if self._kinematics is not None:
            dq = dq / max(float(np.linalg.norm(self._kinematics.jacobian(q)[:3] @ dq)) / TOOL_SPEED, 1.0)
        return np.asarray(dq)

    def _by_tool(self, asked: JogCommand, q: Vector) -> Vector:
        assert self._kinematics is not None
        axes = {"world": np.eye(3), "base": self._kinematics.base_axes, "tool": self._kinematics.fk(q)[:3, :3]}
        turn = axes[asked.frame]
        linear, angular = ([v.x, v.y, v.z] for v in (asked.linear, asked.angular))
        jacobian = self._kinematics.jacobian(q)
        least = float(np.linalg.svd(jacobian, compute_uv=False)[-1])
        damping = DAMPING * max(1 - least / NEAR, 0.0)
        square = jacobian @ jacobian.T + damping**2 * np.eye(6)
        twist = np.concatenate([turn @ linear, turn @ angular])
        dq = np.asarray(jacobian.T @ np.linalg.lstsq(square, twist)[0])
        part = slice(0, 3) if any(linear) else slice(3, 6)
        goes, wanted = (jacobian @ dq)[part], twist[part]
        size = float(np.linalg.norm(wanted))
        if size == 0.0:
            return dq
        aside = goes - (goes @ wanted) / size**2 * wanted
        return np.asarray(dq * max(1 - float(np.linalg.norm(aside)) / size / TURNED, SLOWEST))

    def _require_known(self, request: JogCommand) -> None:
        names = self._limits.names
        unknown = [name for name in request.joints if name not in names]
        tool = any((v.x, v.y, v.z) != (0.0, 0.0, 0.0) for v in (request.linear, request.angular))
        if unknown:
            raise Refused("unknown_joint", f"{unknown[0]!r} is no joint of the arm; choices: {', '.join(names)}")
        if tool and request.joints:
            raise Refused("contradiction", "velocities of joints and of the tool do not go together")
        if tool and self._kinematics is None:
            raise Refused("no_kinematics", "this arm is jogged by its joints only")

    def _bar(self, owner: str, now: float) -> None:
        if owner in self._refused or len(self._refused) < MOST_REFUSED:
            self._refused.pop(owner, None)
            self._refused[owner] = now
