"""The last stage before the hardware: set-points that no arm could follow are replaced by ones that it can.

It checks differences between set-points, whatever computed them, and knows nothing of goals. Set-points within the
limits pass unaltered. The others are approached as fast as the limits allow (ruckig, state to state).
"""

from __future__ import annotations

import numpy as np
import ruckig

from common.hardware.interface import Limits, Vector

SLACK = 0.02  # share by which differences may exceed velocity and acceleration, as for trajectories
POSITION_SLACK = 1e-3  # [rad] the same for positions
ROUNDING = 1e-9  # [rad/s] of a difference of positions
RUCKIG_OK = (ruckig.Result.Working, ruckig.Result.Finished)


class Limiter:
    """Follows requested set-points within limits, from rest.

    Jerk: a change of acceleration in one cycle passes up to `jerk * cycle`, or between two allowed accelerations, since
    trajectories may be planned without a jerk limit. The motion back to the requested set-points keeps the jerk limit.

    Attributes:
        position: newest set-point (dof,) [rad].
    """

    def __init__(self, limits: Limits, start: Vector, period: float) -> None:
        """Start at rest at `start` (dof,) [rad]; `period` of the cycles, cell time [s]."""
        self._period = period
        self._lower, self._upper = limits.lower - POSITION_SLACK, limits.upper + POSITION_SLACK
        self._velocity = limits.velocity
        self._acceleration, self._braking = limits.acceleration, limits.braking
        self._jerk = limits.jerks
        self.rest(start)

    def rest(self, position: Vector | None = None, velocity: Vector | None = None) -> None:
        """Continue from rest at the newest set-point, or at a position (dof,) [rad] where the arm was found.

        An arm found in motion continues at its velocity [rad/s].
        """
        if position is not None:
            self.position = position.copy()
            # A joint found beyond its limit may stay there or move in, and has no more room than that.
            self._allow_up_to(position, position)
        self._step = self._period  # duration of the newest step [s]
        self._mean_velocity = 0.0 * self.position if velocity is None else velocity.copy()  # in it
        self._velocity_at_end = self._mean_velocity
        self._mean_acceleration = 0.0 * self.position  # up to the middle of it
        self._approach_state: tuple[Vector, Vector] | None = None  # velocity and acceleration of an approach
        self._braked = False

    @property
    def at_rest(self) -> bool:
        """Whether the set-point did not move in the newest step."""
        return not self._mean_velocity.any()

    def step(
        self, target: Vector, velocity: Vector, seconds: float, share: float = 1.0, braking: bool = False
    ) -> tuple[Vector, Vector]:
        """Return the set-point after a step (dof,) [rad], [rad/s]: the target itself if that is within limits.

        Args:
            target: requested position (dof,) [rad].
            velocity: requested velocity (dof,) [rad/s].
            seconds: duration of the step, cell time.
            share: of the velocity limits, 0 to 1.
            braking: whether the arm is brought to rest, with the deceleration limits.
        """
        if seconds <= 0.0:
            return self.position, self._mean_velocity if self._mean_velocity.any() else 0.0 * self._mean_velocity
        between = (self._step + seconds) / 2
        mean = (target - self.position) / seconds
        change = (mean - self._mean_velocity) / between
        most = self._braking if braking or self._braked else self._acceleration
        self._braked = braking  # a second difference includes the step before
        if self._passes(target, velocity, mean, change, seconds, between, share, most):
            return self._go(target, velocity, None, seconds)
        return self._go(*self._approach(target, velocity, seconds, share), seconds)

    def _go(
        self, target: Vector, velocity: Vector, acceleration: Vector | None, seconds: float
    ) -> tuple[Vector, Vector]:
        """Set the set-point; in an approach with an acceleration (dof,) [rad/s^2]."""
        self._approach_state = None if acceleration is None else (velocity, acceleration)
        mean = (target - self.position) / seconds
        self._mean_acceleration = (mean - self._mean_velocity) / ((self._step + seconds) / 2)
        self.position, self._mean_velocity, self._step, self._velocity_at_end = target, mean, seconds, velocity
        if self._beyond:
            self._allow_up_to(np.maximum(self._lowest, target), np.minimum(self._highest, target))
        return target, velocity

    def _allow_up_to(self, lowest: Vector, highest: Vector) -> None:
        """Allow positions (dof,) [rad] between the limits, and beyond them up to these."""
        self._lowest, self._highest = np.minimum(self._lower, lowest), np.maximum(self._upper, highest)
        self._beyond = bool((self._lowest < self._lower).any() or (self._highest > self._upper).any())

    def brake(self, seconds: float) -> tuple[Vector, Vector]:
        """Return the set-point after a step (dof,) [rad], [rad/s] of the fastest synchronized motion to rest."""
        return self._toward(0.0 * self.position, self._braking, seconds, together=True)

    def go_at(self, velocity: Vector, seconds: float) -> tuple[Vector, Vector]:
        """Return the set-point after a step (dof,) [rad], [rad/s] towards velocities (dof,) [rad/s], synchronized.

        If a joint could not stop before its end any more, all joints brake.
        """
        left = np.where(self._mean_velocity > 0, self._highest - self.position, self.position - self._lowest)
        speed = np.abs(self._mean_velocity)
        ends = speed * (2 * seconds + speed / (2 * self._acceleration)) > left
        if ends.any():
            return self._toward(0.0 * velocity, self._acceleration, seconds, together=False)
        return self._toward(velocity, self._acceleration, seconds, together=True)

    def _toward(self, velocity: Vector, hardest: Vector, seconds: float, together: bool) -> tuple[Vector, Vector]:
        problem = self._problem(hardest)
        if together:  # so the tool moves straight
            problem.synchronization = ruckig.Synchronization.Phase
        problem.control_interface = ruckig.ControlInterface.Velocity
        problem.target_velocity = velocity.tolist()
        target, velocity, acceleration = _after(problem, seconds)
        return self._go(target, velocity, acceleration, seconds)

    def _passes(
        self, target: Vector, velocity: Vector, mean: Vector, change: Vector, seconds: float, between: float,
        share: float, most: Vector,
    ) -> bool:
        speed = np.abs(mean)
        if not (speed <= self._velocity * (share * (1 + SLACK)) + ROUNDING).all():
            return False
        room = ROUNDING / between
        hardest = most * (1 + SLACK) + room
        jump = np.abs(change - self._mean_acceleration)
        slack_share = 1.0 if self._approach_state is None else 0.5  # an approach ends no faster than it was
        # It must be possible to stop before the end of the joint.
        free = np.where(mean > 0, self._highest - target, target - self._lowest) + ROUNDING
        passes = (
            (np.abs(velocity - mean) <= hardest * (seconds * slack_share) + ROUNDING)
            & (np.abs(change) <= hardest)
            & (jump <= np.maximum(self._jerk * between, 2 * hardest))
            & (speed * (seconds + speed / (2 * self._braking)) <= free)
        )
        return bool(passes.all())

    def _approach(
        self, target: Vector, velocity: Vector, seconds: float, share: float
    ) -> tuple[Vector, Vector, Vector]:
        """Return positions, velocities and accelerations (dof,) after a step on the fastest motion to a target."""
        fastest, hardest = share * self._velocity, self._acceleration
        lower, upper = self._lowest, self._highest
        target = np.clip(np.where(np.isfinite(target), target, self.position), lower, upper)
        free = np.minimum(upper - target, target - lower)  # to reach that velocity, and rest again after another step
        ending = np.minimum(fastest, hardest * (np.sqrt(seconds**2 + free / hardest) - seconds))
        velocity = np.clip(np.where(np.isfinite(velocity), velocity, 0.0), -ending, ending)
        problem = self._problem(hardest)
        problem.target_position, problem.target_velocity = target.tolist(), velocity.tolist()
        problem.max_velocity = fastest.tolist()
        return _after(problem, seconds)

    def _problem(self, hardest: Vector) -> ruckig.InputParameter:
        """Return a ruckig problem that starts at the present state, with an acceleration limit (dof,) [rad/s^2]."""
        if self._approach_state is None:  # assuming a constant, allowed acceleration in the newest step
            most = hardest * (self._step / 2)
            gained = np.clip(self._velocity_at_end - self._mean_velocity, -most, most)
            self._approach_state = self._mean_velocity + gained, gained / (self._step / 2)
        v0, a0 = self._approach_state
        problem = ruckig.InputParameter(len(v0))
        problem.synchronization = ruckig.Synchronization.No
        problem.current_position = self.position.tolist()
        problem.current_velocity, problem.current_acceleration = v0.tolist(), a0.tolist()
        problem.max_velocity = self._velocity.tolist()
        problem.max_acceleration, problem.max_jerk = hardest.tolist(), self._jerk.tolist()
        return problem


def _after(problem: ruckig.InputParameter, seconds: float) -> tuple[Vector, Vector, Vector]:
    """Return positions, velocities and accelerations (dof,) after a step on the solution of a problem."""
    dof = len(problem.current_position)
    otg, motion = ruckig.Ruckig(dof), ruckig.Trajectory(dof)
    try:
        found = otg.calculate(problem, motion) in RUCKIG_OK
    except ruckig.RuckigError:  # for a distance below its resolution
        found = False
    if not found:
        problem.control_interface = ruckig.ControlInterface.Velocity  # come to rest, which always has a solution
        problem.target_velocity = [0.0] * dof
        otg.calculate(problem, motion)
    q, dq, ddq = motion.at_time(seconds)
    return np.array(q), np.array(dq), np.array(ddq)
