"""The last stage before the hardware: set-points that no arm could follow are replaced by ones that it can.

It judges what leaves the executor by differences between set-points, whatever made them, and knows nothing of goals.
What is within limits passes unaltered. The rest is approached as fast as the limits allow (ruckig, a state to a state).
"""

from __future__ import annotations

import numpy as np
import ruckig

from common.hardware.interface import Limits, Vector

SLACK = 0.02  # share by which differences may exceed velocity and acceleration: as much as is accepted
POSITION_SLACK = 1e-3  # [rad] the same of positions
ROUNDING = 1e-9  # [rad/s] of a difference of positions: numbers are not exact
RUCKIG_OK = (ruckig.Result.Working, ruckig.Result.Finished)


class Limiter:
    """Follows the set-points that it is given within limits, from rest.

    Jerk: a change of acceleration in one cycle passes up to `jerk * cycle`, or when it is between two accelerations
    that are allowed, since trajectories are planned without a limit of jerk. What this stage adds of its own, on the
    way back to what it is given, holds the limits of jerk.

    Attributes:
        position: newest set-point (dof,) [rad].
    """

    def __init__(self, limits: Limits, start: Vector, period: float) -> None:
        """Be at rest at `start` (dof,) [rad]; `period` of the cycles, cell time [s]."""
        self._period = period
        self._lower, self._upper = limits.lower - POSITION_SLACK, limits.upper + POSITION_SLACK
        self._velocity = limits.velocity
        self._acceleration, self._braking = limits.acceleration, limits.braking
        self._jerk = limits.jerks
        self.rest(start)

    def rest(self, position: Vector | None = None, velocity: Vector | None = None) -> None:
        """Go on from rest: where the set-point is, or at a position (dof,) [rad] where the arm was found.

        An arm that was found in motion goes on at its velocity [rad/s].
        """
        if position is not None:
            self.position = position.copy()
            # A joint that is found beyond its limit may stay there or come in, and then has no more room than that.
            self._leave_room(position, position)
        self._step = self._period  # duration of the newest step [s]
        self._way = 0.0 * self.position if velocity is None else velocity.copy()  # mean velocity in it
        self._told = self._way  # velocity at its end
        self._change = 0.0 * self.position  # mean acceleration up to the middle of it
        self._kept: tuple[Vector, Vector] | None = None  # velocity and acceleration where a way back goes on
        self._braked = False

    @property
    def at_rest(self) -> bool:
        """Whether nothing moved in the newest step."""
        return not self._way.any()

    def step(
        self, target: Vector, velocity: Vector, seconds: float, share: float = 1.0, braking: bool = False
    ) -> tuple[Vector, Vector]:
        """The set-point after a step (dof,) [rad], [rad/s]: the target itself when that is within limits.

        Args:
            target: where to be (dof,) [rad].
            velocity: with which velocity (dof,) [rad/s].
            seconds: duration of the step, cell time.
            share: of the velocity limits that is to be had, 0 to 1.
            braking: whether the arm is being brought to rest, for which limits may be higher.
        """
        if seconds <= 0.0:
            return self.position, self._way if self._way.any() else 0.0 * self._way
        between = (self._step + seconds) / 2
        way = (target - self.position) / seconds
        change = (way - self._way) / between
        most = self._braking if braking or self._braked else self._acceleration
        self._braked = braking  # a difference of second order reaches one step further back
        if self._passes(target, velocity, way, change, seconds, between, share, most):
            return self._go(target, velocity, None, seconds)
        return self._go(*self._approach(target, velocity, seconds, share), seconds)

    def _go(
        self, target: Vector, velocity: Vector, acceleration: Vector | None, seconds: float
    ) -> tuple[Vector, Vector]:
        """Be at a target; on a way of our own with an acceleration (dof,) [rad/s^2]."""
        self._kept = None if acceleration is None else (velocity, acceleration)
        way = (target - self.position) / seconds
        self._change = (way - self._way) / ((self._step + seconds) / 2)
        self.position, self._way, self._step, self._told = target, way, seconds, velocity
        if self._beyond:
            self._leave_room(np.maximum(self._lowest, target), np.minimum(self._highest, target))
        return target, velocity

    def _leave_room(self, lowest: Vector, highest: Vector) -> None:
        """Have all positions (dof,) [rad] between the limits allowed, and beyond them up to these."""
        self._lowest, self._highest = np.minimum(self._lower, lowest), np.maximum(self._upper, highest)
        self._beyond = bool((self._lowest < self._lower).any() or (self._highest > self._upper).any())

    def brake(self, seconds: float) -> tuple[Vector, Vector]:
        """The set-point after a step (dof,) [rad], [rad/s] to rest, wherever that is: all joints together, soon."""
        return self._toward(0.0 * self.position, self._braking, seconds, together=True)

    def go_at(self, velocity: Vector, seconds: float) -> tuple[Vector, Vector]:
        """The set-point after a step (dof,) [rad], [rad/s] towards velocities (dof,) [rad/s], all joints alike.

        A joint that comes nearer to its end than it can be braked in brakes, whatever is asked for, and so do all.
        """
        left = np.where(self._way > 0, self._highest - self.position, self.position - self._lowest)
        speed = np.abs(self._way)
        ends = speed * (2 * seconds + speed / (2 * self._acceleration)) > left
        if ends.any():
            return self._toward(0.0 * velocity, self._acceleration, seconds, together=False)
        return self._toward(velocity, self._acceleration, seconds, together=True)

    def _toward(self, velocity: Vector, hardest: Vector, seconds: float, together: bool) -> tuple[Vector, Vector]:
        given = self._given(hardest)
        if together:  # the tool goes straight then
            given.synchronization = ruckig.Synchronization.Phase
        given.control_interface = ruckig.ControlInterface.Velocity
        given.target_velocity = velocity.tolist()
        target, velocity, acceleration = _after(given, seconds)
        return self._go(target, velocity, acceleration, seconds)

    def _passes(
        self, target: Vector, velocity: Vector, way: Vector, change: Vector, seconds: float, between: float,
        share: float, most: Vector,
    ) -> bool:
        speed = np.abs(way)
        if not (speed <= self._velocity * (share * (1 + SLACK)) + ROUNDING).all():
            return False
        room = ROUNDING / between
        hardest = most * (1 + SLACK) + room
        jump = np.abs(change - self._change)
        goes_on = 1.0 if self._kept is None else 0.5  # what is caught up with is left no faster than it was reached
        # With the velocity that it has it must be possible to stop before the end of the joint.
        free = np.where(way > 0, self._highest - target, target - self._lowest)
        if self._beyond:
            beyond = np.where(way > 0, self._highest > self._upper, self._lowest < self._lower)
            free += np.where(beyond, ROUNDING, POSITION_SLACK)
        else:
            free += POSITION_SLACK
        passes = (
            (np.abs(velocity - way) <= hardest * (seconds * goes_on) + ROUNDING)
            & (np.abs(change) <= hardest)
            & (jump <= np.maximum(self._jerk * between, 2 * hardest))
            & (speed * (seconds + speed / (2 * self._braking)) <= free)
        )
        return bool(passes.all())

    def _approach(
        self, target: Vector, velocity: Vector, seconds: float, share: float
    ) -> tuple[Vector, Vector, Vector]:
        """Positions, velocities and accelerations (dof,) after a step on the fastest way to a target."""
        fastest, hardest = share * self._velocity, self._acceleration
        lower, upper = self._lowest, self._highest
        target = np.clip(np.where(np.isfinite(target), target, self.position), lower, upper)
        free = np.minimum(upper - target, target - lower)  # to come to that velocity, and to rest again
        ending = np.minimum(fastest, np.sqrt(hardest * free))
        velocity = np.clip(np.where(np.isfinite(velocity), velocity, 0.0), -ending, ending)
        given = self._given(hardest)
        given.target_position, given.target_velocity = target.tolist(), velocity.tolist()
        given.max_velocity = fastest.tolist()
        return _after(given, seconds)

    def _given(self, hardest: Vector) -> ruckig.InputParameter:
        """The state of now, and an acceleration that is not exceeded (dof,) [rad/s^2]."""
        if self._kept is None:  # by an even acceleration in the newest step, which is one that is allowed
            most = hardest * (self._step / 2)
            gained = np.clip(self._told - self._way, -most, most)
            self._kept = self._way + gained, gained / (self._step / 2)
        v0, a0 = self._kept
        given = ruckig.InputParameter(len(v0))
        given.synchronization = ruckig.Synchronization.No
        given.current_position = self.position.tolist()
        given.current_velocity, given.current_acceleration = v0.tolist(), a0.tolist()
        given.max_velocity = self._velocity.tolist()
        given.max_acceleration, given.max_jerk = hardest.tolist(), self._jerk.tolist()
        return given


def _after(given: ruckig.InputParameter, seconds: float) -> tuple[Vector, Vector, Vector]:
    """Positions, velocities and accelerations (dof,) after a step on the fastest way to what is given."""
    dof = len(given.current_position)
    otg, motion = ruckig.Ruckig(dof), ruckig.Trajectory(dof)
    try:
        found = otg.calculate(given, motion) in RUCKIG_OK
    except ruckig.RuckigError:  # of a way of less than it can compute with
        found = False
    if not found:
        given.control_interface = ruckig.ControlInterface.Velocity  # come to rest, which always has a solution
        given.target_velocity = [0.0] * dof
        otg.calculate(given, motion)
    q, dq, ddq = motion.at_time(seconds)
    return np.array(q), np.array(dq), np.array(ddq)
