"""Estimate the wrench at the tool from a force sensor: shifted to the TCP, without payload and bias, low-passed.

A wrench is (6,): force [N], then torque [N m]. Signs are those of what acts on the tool: a tool that hangs down and is
pushed up by a table reads the push, not the reaction.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from common.errors import Refused
from common.hardware.interface import Vector
from common.robot.transforms import invert

GRAVITY = 9.81  # [m/s^2]
REST = 0.2  # [s] at rest whose mean becomes the zero


class Payload(NamedTuple):
    """Mass [kg] and centre of mass [m] from the flange, in its axes."""

    mass: float = 0.0
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    @property
    def com(self) -> Vector:
        """Centre of mass (3,) [m]."""
        return np.array([self.x, self.y, self.z])

    def with_other(self, other: Payload) -> Payload:
        """Return both payloads as one."""
        return self.without(other._replace(mass=-other.mass))

    def without(self, other: Payload) -> Payload:
        """Return what is left of the payload without another one; its mass may be negative."""
        mass, moment = self.mass - other.mass, self.mass * self.com - other.mass * other.com
        return Payload(mass, *(moment / mass).tolist()) if abs(mass) > 1e-9 else Payload()


NOTHING = Payload()


class FlangeKinematics(Protocol):
    """What the estimator needs of the robot's model."""

    def fk(self, q: Vector) -> NDArray[np.float64]:
        """Return T_world_tcp (4, 4) at q (dof,) [rad]."""

    def jacobian(self, q: Vector) -> NDArray[np.float64]:
        """Return the Jacobian (6, dof) of the TCP, linear then angular, along the axes of world."""

    @property
    def T_flange_tcp(self) -> NDArray[np.float64]:  # noqa: N802
        """Pose (4, 4) of the TCP in the flange."""


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product of (3,) and (3,): much faster than numpy's in a control cycle."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def shifted(wrench: Vector, T: NDArray[np.float64]) -> Vector:
    """Return a wrench (6,) at the origin and along the axes of a frame with the pose T (4, 4) in the wrench's frame."""
    force, torque = wrench[:3], wrench[3:]
    return np.concatenate([force @ T[:3, :3], (torque - cross(T[:3, 3], force)) @ T[:3, :3]])


def weight(payload: Payload, acceleration: Vector) -> Vector:
    """Return the wrench (6,) of a payload at the flange, along its axes.

    Args:
        payload: a point mass.
        acceleration: gravity minus the acceleration of the centre of mass (3,) [m/s^2], along the axes of the flange.
    """
    force = payload.mass * acceleration
    return np.concatenate([force, cross(payload.com, force)])


class WrenchEstimator:
    """The wrench that the environment exerts on the tool, at the TCP, along its axes.

    Attributes:
        wrench: newest estimate (6,), low-passed; None without a reading.
        unfiltered: the same without the low-pass.
        zeroed: whether `zero` was called.
    """

    def __init__(
        self, kinematics: FlangeKinematics, *, bandwidth: float = 20.0, inertia: bool = True,
    ) -> None:
        """Filter with a first-order low-pass of this bandwidth at -3 dB [Hz].

        With `inertia`, the force that accelerates the payload is subtracted, too.
        """
        self._kinematics, self._inertia = kinematics, inertia
        self._T_flange_tcp = kinematics.T_flange_tcp
        self._T_tcp_flange = invert(self._T_flange_tcp)
        self._rate = 2 * math.pi * bandwidth
        self._bias = np.zeros(6)  # of the sensor, along its axes
        self._at_rest: deque[tuple[float, Vector]] = deque()  # time, compensated reading before the bias
        self._now, self._payload = 0.0, Payload()
        self._last: tuple[float, Payload, Vector] | None = None  # time, payload, velocity of its centre of mass
        self.wrench: Vector | None = None
        self.unfiltered: Vector | None = None
        self.zeroed = False

    def lose(self) -> None:
        """Forget the estimate: the sensor does not report."""
        self.wrench = self.unfiltered = self._last = None
        self._at_rest.clear()

    def update(
        self, now: float, raw: Vector, q: Vector, dq: Vector, payload: Payload = NOTHING, at_rest: bool = False
    ) -> Vector:
        """Return the new estimate.

        Args:
            now: time of the reading [s].
            raw: (6,) what acts on the flange, along its axes, with the weight of the payload.
            q: joint positions (dof,) [rad].
            dq: joint velocities (dof,) [rad/s].
            payload: what of the load beyond the flange `raw` contains.
            at_rest: whether the arm is at standstill.
        """
        T_world_flange = self._kinematics.fk(q) @ self._T_tcp_flange
        acceleration = np.array([0.0, 0.0, -GRAVITY])
        if self._inertia and payload.mass:
            acceleration = acceleration - self._acceleration(now, payload, T_world_flange, q, dq)
        compensated = raw - weight(payload, T_world_flange[:3, :3].T @ acceleration)
        if not at_rest or payload != self._payload:
            self._at_rest.clear()
        self._payload = payload
        if at_rest:
            self._at_rest.append((now, compensated))
            while now - self._at_rest[0][0] > REST + 1e-6:
                self._at_rest.popleft()
        passed, self._now = (now - self._now if self.wrench is not None else 0.0), now
        self.unfiltered = shifted(compensated - self._bias, self._T_flange_tcp)
        if self.wrench is None:
            self.wrench = self.unfiltered
        else:
            self.wrench = self.wrench + (1 - math.exp(-self._rate * passed)) * (self.unfiltered - self.wrench)
        return self.wrench

    def _acceleration(
        self, now: float, payload: Payload, T_world_flange: NDArray[np.float64], q: Vector, dq: Vector
    ) -> Vector:
        """Return the acceleration (3,) [m/s^2] of the payload's centre of mass in world since the last reading."""
        twist = self._kinematics.jacobian(q) @ dq
        arm = T_world_flange[:3, :3] @ (payload.com - self._T_flange_tcp[:3, 3])  # from the TCP
        velocity = twist[:3] + cross(twist[3:], arm)
        last, self._last = self._last, (now, payload, velocity)
        if last is None or last[1] != payload or now <= last[0]:
            return np.zeros(3)
        return np.asarray((velocity - last[2]) / (now - last[0]))

    def zero(self) -> None:
        """Take the mean of the last REST seconds as zero: of a bias of the sensor, for every orientation.

        Raises:
            Refused: the arm moves (`moving`), was not at rest for that long (`settling`), or reports no force.
        """
        if self.wrench is None:
            raise Refused("no_wrench", "the arm reports no force")
        rest = self._at_rest[-1][0] - self._at_rest[0][0] if self._at_rest else 0.0
        if rest < REST - 0.02:
            raise Refused("settling" if self._at_rest else "moving",
                          f"the arm must be at rest for {REST:g} s, and is for {rest:.2f} s")
        self._bias = np.mean([reading for _, reading in self._at_rest], axis=0)
        self.wrench = self.unfiltered = np.zeros(6)
        self.zeroed = True


class Wrenches(NamedTuple):
    """What the environment exerts on the tool (6,) [N, N m], at the TCP along its axes: low-passed, and newest."""

    smooth: Vector
    newest: Vector

    @classmethod
    def of(cls, estimator: WrenchEstimator | None) -> Wrenches | None:
        """Return the estimate of this cycle; None while there is none."""
        if estimator is None or estimator.wrench is None or estimator.unfiltered is None:
            return None
        return cls(estimator.wrench, estimator.unfiltered)
