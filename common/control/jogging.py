"""Jogging: joint or tool velocities that an operator keeps sending. When they cease, the arm comes to rest.

The arm brakes `DEADMAN` after the newest command and is at rest `BRAKING_TIME` later, so it is moved no faster than
that allows. After a refusal or an interruption, commands count again only after a pause: an operator who held the
button pressed over a stop must release it first.
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
BRAKING_TIME = 0.1  # [s] after that: both together are what is promised
PAUSE = 0.3  # [s] wall without a command, after a refused one
TOOL_SPEED = 0.25  # [m/s] of the TCP at most: manual reduced speed of ISO 10218-1
ACCELERATION_SHARE = 0.5  # of the acceleration is used to slow down before the end of a joint,
END_TIME = 0.15  # [s] time constant of the approach to that end
DAMPING = 0.05  # of the least squares, where the tool loses a direction
NEAR_SINGULAR = 0.02  # [m, rad per rad] least singular value of the Jacobian below which it is damped
MAX_REFUSED = 16  # remembered names; while there are more, new names are refused
MAX_ASIDE = 0.3  # deviation from the requested direction at which the tool moves slowest, relative to the request
SLOWEST = 0.2  # share of the speed with which it still moves there, and leaves again


class ToolKinematics(Protocol):
    """What jogging needs of the robot's model."""

    def fk(self, q: Vector) -> NDArray[np.float64]:
        """Return T_world_tcp (4, 4) at q (dof,) [rad]."""

    def jacobian(self, q: Vector) -> NDArray[np.float64]:
        """Return the Jacobian (6, dof) of the TCP, linear then angular, along the axes of world."""

    @property
    def base_axes(self) -> NDArray[np.float64]:
        """Axes of the base in world (3, 3)."""


def stoppable_velocity(seconds: float, limits: Limits) -> Vector:
    """Return velocities (dof,) [rad/s] from which joints come to rest in that time, with no acceleration at both ends.

    At a jerk j up to a deceleration a: v = a (t - a/j), and j t^2 / 4 where a is not reached.
    """
    a, j = limits.braking, limits.jerks
    return np.where(a / j >= seconds / 2, j * seconds**2 / 4, a * (seconds - a / j))


def velocity_before_end(room: Vector, limits: Limits) -> Vector:
    """Return the velocities (dof,) [rad/s] allowed to joints with so much room [rad] before their ends."""
    left = np.maximum(room, 0.0)
    return np.minimum(np.sqrt(2 * ACCELERATION_SHARE * limits.acceleration * left), left / END_TIME)


class Jogging:
    """Turns the newest command into joint velocities."""

    def __init__(self, limits: Limits, kinematics: ToolKinematics | None) -> None:
        """Jog an arm with these limits; without kinematics only its joints."""
        self._limits, self._kinematics = limits, kinematics
        self._fastest = np.minimum(limits.velocity, stoppable_velocity(BRAKING_TIME, limits))
        self._command: JogCommand | None = None
        self._received = 0.0  # [s] wall: time of that command
        self._started: float | None = None  # [s] wall: commands soon after may belong to a stream before a restart
        self._refused: OrderedDict[str, float] = OrderedDict()  # time of the last ignored command by name

    @property
    def owner(self) -> str:
        """Name of the operator who jogs; empty without one."""
        return self._command.owner if self._command else ""

    def command(self, request: JogCommand, now: float, refusal: Refused | None = None) -> None:
        """Jog as requested from now on, at wall time [s], unless there is a `refusal` already.

        Raises:
            Refused: with the reason.
        """
        before = self._refused.get(request.owner)
        try:
            early = self._started is None or now - self._started < PAUSE
            crowded = len(self._refused) >= MAX_REFUSED and request.owner != self.owner
            if early or crowded or (before is not None and now - before < PAUSE):
                raise Refused("let_go", f"jogging was ended: release the button for {PAUSE:g} s")
            if refusal is not None:
                raise refusal
            if self._command is not None and self._command.owner != request.owner:
                raise Refused("busy", f"{self._command.owner} jogs the arm")
            self._require_valid(request)
        except Refused:
            self._bar(request.owner, now)
            raise
        self._refused.pop(request.owner, None)
        self._command, self._received = request, now

    def interrupt(self, now: float) -> None:
        """Come to rest; the operator must release the button first; wall time [s]."""
        if self._command is not None:
            self._bar(self._command.owner, now)
            self._command = None

    def velocity(self, q: Vector, now: float, share: float) -> Vector | None:
        """Return the joint velocities (dof,) [rad/s], or None to come to rest.

        Args:
            q: newest set-point (dof,) [rad].
            now: wall time [s].
            share: of the velocity limits, 0 to 1.
        """
        self._started = now if self._started is None else self._started
        while self._refused and now - next(iter(self._refused.values())) >= PAUSE:
            self._refused.popitem(last=False)
        command = self._command
        if command is None:
            return None
        if now - self._received > DEADMAN:
            self._command = None
            return None
        limits = self._limits
        lowest = -velocity_before_end(q - limits.lower, limits)
        highest = velocity_before_end(limits.upper - q, limits)
        if command.joints:
            dq = np.clip([command.joints.get(name, 0.0) for name in limits.names], lowest, highest)
        else:
            dq = self._by_tool(command, q)
            with np.errstate(divide="ignore", invalid="ignore"):  # the slowest joint keeps the direction
                room = np.where(dq < 0, lowest, highest) / dq
            dq = dq * min(float(np.min(room, where=dq != 0, initial=1.0)), 1.0)
        if not dq.any():
            return None
        dq = dq / max(float((np.abs(dq) / np.minimum(self._fastest, share * limits.velocity)).max()), 1.0)
        if self._kinematics is not None:
            dq = dq / max(float(np.linalg.norm(self._kinematics.jacobian(q)[:3] @ dq)) / TOOL_SPEED, 1.0)
        return np.asarray(dq)

    def _by_tool(self, command: JogCommand, q: Vector) -> Vector:
        assert self._kinematics is not None
        axes = {"world": np.eye(3), "base": self._kinematics.base_axes, "tool": self._kinematics.fk(q)[:3, :3]}
        rotation = axes[command.frame]
        linear, angular = ([v.x, v.y, v.z] for v in (command.linear, command.angular))
        jacobian = self._kinematics.jacobian(q)
        least = float(np.linalg.svd(jacobian, compute_uv=False)[-1])
        damping = DAMPING * max(1 - least / NEAR_SINGULAR, 0.0)
        square = jacobian @ jacobian.T + damping**2 * np.eye(6)
        twist = np.concatenate([rotation @ linear, rotation @ angular])
        dq = np.asarray(jacobian.T @ np.linalg.lstsq(square, twist)[0])
        part = slice(0, 3) if any(linear) else slice(3, 6)
        actual, requested = (jacobian @ dq)[part], twist[part]
        size = float(np.linalg.norm(requested))
        if size == 0.0:
            return dq
        aside = actual - (actual @ requested) / size**2 * requested
        return np.asarray(dq * max(1 - float(np.linalg.norm(aside)) / size / MAX_ASIDE, SLOWEST))

    def _require_valid(self, request: JogCommand) -> None:
        names = self._limits.names
        unknown = [name for name in request.joints if name not in names]
        tool = any((v.x, v.y, v.z) != (0.0, 0.0, 0.0) for v in (request.linear, request.angular))
        if unknown:
            raise Refused("unknown_joint", f"{unknown[0]!r} is no joint of the arm; choices: {', '.join(names)}")
        if tool and request.joints:
            raise Refused("contradiction", "velocities of joints and of the tool exclude each other")
        if tool and self._kinematics is None:
            raise Refused("no_kinematics", "this arm can only be jogged joint by joint")

    def _bar(self, owner: str, now: float) -> None:
        if owner in self._refused or len(self._refused) < MAX_REFUSED:
            self._refused.pop(owner, None)
            self._refused[owner] = now
