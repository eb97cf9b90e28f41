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
NEAR_SINGULAR = 0.02  # [m, rad per rad] singular value of the Jacobian below which the tool is at the end of its reach
LOST = 0.002  # below that a direction counts as lost
MAX_REFUSED = 16  # remembered names; while there are more, new names are refused
MAX_ASIDE = 0.05  # deviation from the requested direction, relative to the request: 3 degrees
SLOWEST = 0.05  # share of the possible speed at which the tool stops there
STALLED = 0.01  # share of the requested speed below which the end of a joint has stopped the tool
ENDED = "jogging ended: the tool cannot keep its direction, as"


class DirectionLost(Exception):
    """The tool cannot keep the requested direction, with the reason."""


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
    """Turns the newest command into joint velocities.

    Attributes:
        ended: why jogging ended by itself; empty again from the next accepted command on.
    """

    def __init__(self, limits: Limits, kinematics: ToolKinematics | None) -> None:
        """Jog an arm with these limits; without kinematics only its joints."""
        self._limits, self._kinematics = limits, kinematics
        self._fastest = np.minimum(limits.velocity, stoppable_velocity(BRAKING_TIME, limits))
        self.ended = ""
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
        self._command, self._received, self.ended = request, now, ""

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
            try:
                dq = self._before_ends(self._by_tool(command, q), lowest, highest)
            except DirectionLost as reason:
                self.interrupt(now)
                self.ended = f"{ENDED} {reason}"
                return None
        if not dq.any():
            return None
        dq = dq / max(float((np.abs(dq) / np.minimum(self._fastest, share * limits.velocity)).max()), 1.0)
        if self._kinematics is not None:
            dq = dq / max(float(np.linalg.norm(self._kinematics.jacobian(q)[:3] @ dq)) / TOOL_SPEED, 1.0)
        return np.asarray(dq)

    def _before_ends(self, dq: Vector, lowest: Vector, highest: Vector) -> Vector:
        """Return velocities (dof,) [rad/s] slowed down in proportion: the slowest joint keeps the direction.

        Raises:
            DirectionLost: a joint is at its end.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(dq == 0, np.inf, np.where(dq < 0, lowest, highest) / dq)
        joint = int(np.argmin(room))
        if room[joint] < STALLED:
            raise DirectionLost(f"{self._limits.names[joint]} is at its limit")
        return dq * min(float(room[joint]), 1.0)

    def _by_tool(self, command: JogCommand, q: Vector) -> Vector:
        """Return joint velocities (dof,) [rad/s] that move the tool as requested, or slower if joints are too slow.

        An arm of fewer than six joints leaves free what is not requested: position or orientation.

        Raises:
            DirectionLost: the tool is at the end of its reach and would move on, or has lost the direction.
        """
        assert self._kinematics is not None
        axes = {"world": np.eye(3), "base": self._kinematics.base_axes, "tool": self._kinematics.fk(q)[:3, :3]}
        rotation = axes[command.frame]
        linear, angular = (np.array([v.x, v.y, v.z]) for v in (command.linear, command.angular))
        requested = slice(0, 3) if not angular.any() else slice(3, 6) if not linear.any() else slice(0, 6)
        rows = requested if len(q) < 6 else slice(0, 6)
        twist = np.concatenate([rotation @ linear, rotation @ angular])
        size = float(np.linalg.norm(twist))
        if size == 0.0:
            return np.zeros(len(q))
        jacobian = self._kinematics.jacobian(q)
        left, values, right = np.linalg.svd(jacobian[rows], full_matrices=False)
        parts = left.T @ twist[rows]
        dq = np.asarray((np.where(values > LOST, 1 / np.maximum(values, LOST), values / LOST**2) * parts) @ right)
        actual = (jacobian @ dq)[requested]
        aside = actual - float(actual @ twist[requested]) / size**2 * twist[requested]
        along = float(actual @ twist[requested]) / size
        if float(np.linalg.norm(aside)) > MAX_ASIDE * along:
            raise DirectionLost("the arm is in a singular pose: jog its joints out of it")
        share = 1.0
        if values[-1] < 2 * NEAR_SINGULAR and abs(parts[-1]) > MAX_ASIDE * size:
            ahead = self._kinematics.jacobian(q + 1e-3 * dq / np.abs(dq).max())[rows]
            if np.linalg.svd(ahead, compute_uv=False)[-1] < values[-1]:
                share = float(values[-1]) / NEAR_SINGULAR - 1  # slow where it stops: braking joints leave the line
                if share < SLOWEST:
                    raise DirectionLost("the arm is at the end of its reach, or near a singular pose: jog another way")
        return np.asarray(share * dq / max(float((np.abs(dq) / self._fastest).max()), 1.0))

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
