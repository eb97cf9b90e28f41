"""Set-points of a force motion: the law's velocity along the planned line, within limits of joints, force and torque.

The tool is moved relative to the pose at the start; the planned joint path decides what the redundant joints do.
Exceeding the hard limit ends the motion whatever the law does: the arm brakes, then backs off along the line that it
came from, until the force is low or for BACK_OFF at most.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.control.force_laws import STOPPING_TIME, Law, Sample, along, law_of
from common.control.goals import Goal, Outcome
from common.control.jogging import ToolKinematics
from common.control.limiter import Limiter
from common.control.trajectory import Trajectory
from common.control.wrench import Wrenches
from common.errors import Refused
from common.hardware.interface import Limits
from common.messages import ForceMotion

Array = NDArray[np.float64]

LINE = 2e-3  # [m] by which the planned path may leave the line, and the set-points what the law asks for
TURN = 0.02  # [rad] the same of rotations
SAMPLES = 41  # of the planned path
GAIN = 20.0  # [1/s] with which set-points return to what the law asks for
POSTURE_GAIN = 2.0  # [1/s] with which redundant joints return to the planned path
DAMPING = 0.01  # of the pseudo-inverse, near singular poses
BACK_OFF, BACK_OFF_SPEED = 5e-3, 0.01  # [m], [m/s] after the hard limit was exceeded
RELIEVED = 0.3  # share of the limit at which the arm stops to back off
ZERO_TIMEOUT = 2.0  # [s] for an arm to be at rest for so long that its wrench can be zeroed
CYCLE_SHARE = 0.9  # of a cycle in which the arm must be able to brake


class ForceFollower:
    """Follows one force motion.

    Attributes:
        line: planned positions (SAMPLES, dof) [rad] at equal distances.
        end: how the motion ends, from when it is known; the arm comes to rest first.
        zeroing: whether the arm stays at rest until the wrench is zeroed.
    """

    def __init__(
        self, request: ForceMotion, trajectory: Trajectory, kinematics: ToolKinematics, limits: Limits, start: Array,
        most_force: float, most_torque: float, period: float,
    ) -> None:
        """Prepare a motion from set-points `start` (dof,) [rad]; a request only lowers the hard limits [N, N m].

        Raises:
            Refused: the trajectory is no straight line of the tool in that direction, or the speed is too high.
        """
        self._request, self._kinematics, self._limits = request, kinematics, limits
        self.most_force = min(most_force, request.force_limit or most_force)
        self.most_torque = min(most_torque, request.torque_limit or most_torque)
        if request.force >= self.most_force:
            raise Refused("force_limit", f"a force of {request.force:g} N is not below the limit of "
                                         f"{self.most_force:g} N")
        self._T0 = kinematics.fk(start)
        d = np.array([request.direction.x, request.direction.y, request.direction.z])
        frames = {"base": kinematics.base_axes, "tool": self._T0[:3, :3], "world": np.eye(3)}
        d = frames[request.frame] @ (d / np.linalg.norm(d))
        self._axes = _axes(d)
        self._arm = self._T0[:3, :3].T @ d * request.tip  # from the TCP to the contact point, in tool axes
        self._origin = self._T0[:3, 3] + self._T0[:3, :3] @ self._arm
        self._times, self.line = self._planned(trajectory, start)
        self._require_stoppable(start, period)
        self._law: Law = law_of(request)
        self._offset = np.zeros(6)  # as the law asks for
        self._time = 0.0  # in motion [s]
        self.end: Outcome | None = None
        self.zeroing, self._waited = request.zero, 0.0  # [s] for it
        self._wrench: Wrenches | None = None
        self._last: Sample | None = None  # by which the end was decided
        self._backing = False
        self._low = np.inf  # [m] distance at which the arm stops to back off
        self.sample = Sample(0.0, *np.zeros((4, 6)))

    # --- acceptance -----------------------------------------------------------------------------------------------

    def _planned(self, trajectory: Trajectory, start: Array) -> tuple[Array, Array]:
        """Return times (SAMPLES,) and positions (SAMPLES, dof) [rad] of the path, which is checked.

        Raises:
            Refused: it is not the line.
        """
        times = np.linspace(0.0, trajectory.duration, 4 * SAMPLES)
        path = trajectory.positions_at(times)
        offsets = np.array([self._offset_of(q) for q in path])
        aside = np.linalg.norm(offsets[:, :2], axis=1)
        turned = np.linalg.norm(offsets[:, 3:], axis=1)
        reached, most = float(offsets[-1, 2]), self._request.max_distance
        if aside.max() > LINE or turned.max() > TURN or offsets[:, 2].min() < -LINE:
            raise Refused("path_mismatch", "the trajectory is no straight line in the direction: the tool leaves it "
                                           f"by {1e3 * aside.max():.1f} mm and {turned.max():.3f} rad")
        if reached < most - LINE:
            raise Refused("path_mismatch", f"the trajectory ends after {1e3 * reached:.1f} mm, before max_distance, "
                                           f"{1e3 * most:g} mm")
        along = np.maximum.accumulate(offsets[:, 2])
        wanted = np.linspace(0.0, most, SAMPLES)
        found = np.interp(wanted, along, times)
        return found, trajectory.positions_at(found)

    def _require_stoppable(self, start: Array, period: float) -> None:
        """Raise Refused if the arm cannot brake within a cycle, and so not within 20 ms of a force."""
        fastest = 0.0
        for q in self.line[:: SAMPLES // 4]:
            dq = np.abs(_inverse(self._jacobian(q)) @ self._twist(along(1.0)))
            a, j = self._limits.braking, self._limits.jerks
            seconds = CYCLE_SHARE * period
            stoppable = np.where(seconds > 2 * a / j, a * (seconds - a / j), j * seconds**2 / 4)
            fastest = max(fastest, float((dq / stoppable).max()))
        if self._request.speed * fastest > 1.0:
            raise Refused("too_fast", f"speed {self._request.speed:g} m/s: the arm stops within {1e3 * period:g} ms "
                                      f"only from {np.floor(1e4 / fastest) / 1e4:g} m/s here")

    # --- the cycle ------------------------------------------------------------------------------------------------

    def set_points(
        self, goal: Goal, now: float, elapsed: float, limiter: Limiter, share: float, held: bool
    ) -> tuple[Array, Array]:
        """Return set-points (dof,) [rad], [rad/s] after a cycle.

        Args:
            goal: gets its time on the planned path, and its end.
            now: cell time [s].
            elapsed: since the newest set-point, cell time [s].
            limiter: of the set-points.
            share: of the speed, 0 to 1.
            held: whether the arm is to come to rest on its path.
        """
        if self.end is None and not goal.stopping:
            self._check_limits()
        if self.zeroing and self.end is None:
            self._waited += 0.0 if held else elapsed
            if self._waited > ZERO_TIMEOUT:
                self.end = Outcome("aborted", "not_zeroed", f"the arm was not at rest for long enough within "
                                                            f"{ZERO_TIMEOUT:g} s to zero the wrench")
        ending = goal.stopping or held or (self.end is not None and not self._backing)
        if ending or self.zeroing:
            found = limiter.brake(elapsed)
            self._offset = self._offset_of(found[0])
            if limiter.at_rest and ending and not held:
                self._at_rest(goal, now)
        else:
            found = self._advance(limiter, elapsed, share)
        goal.time = float(np.interp(self._offset[2], np.linspace(0.0, self._request.max_distance, SAMPLES),
                                    self._times))
        goal.pace.rate = 0.0 if limiter.at_rest else share
        goal.behind = 0.0
        return found

    def sense(self, measured: Array, wrench: Wrenches | None) -> None:
        """Take the reading of this cycle: joint positions (dof,) [rad], and the wrench, None while it is unknown."""
        self._wrench, found = wrench, np.zeros((2, 6))
        if wrench is not None:
            R = self._axes.T @ self._kinematics.fk(measured)[:3, :3]
            for into, at_tcp in zip(found, wrench, strict=True):  # the torque about the contact point
                torque = at_tcp[3:] - np.cross(self._arm, at_tcp[:3])
                into[:] = np.concatenate([R @ at_tcp[:3], R @ torque])
        self.sample = Sample(self._time, self._offset.copy(), self._offset_of(measured), *found)

    def resume(self, position: Array) -> None:
        """Continue from rest at a position (dof,) [rad]."""
        self._offset = self._offset_of(position)

    @property
    def result(self) -> tuple[float, float]:
        """Force of the tool along the direction [N], and measured distance in it [m]: at the end, else now."""
        sample = self._last or self.sample
        return round(sample.contact, 2), round(float(sample.measured[2]), 6)

    def _check_limits(self) -> None:
        wrench = self._wrench
        if wrench is None:
            self.end = Outcome("aborted", "no_wrench", "the wrench at the tool is not measured any more")
            return
        force, torque = (float(np.linalg.norm(part)) for part in (wrench.newest[:3], wrench.newest[3:]))
        if force > self.most_force or torque > self.most_torque:
            what = (f"force {force:.1f} N exceeds the limit of {self.most_force:g} N" if force > self.most_force else
                    f"torque {torque:.2f} N m exceeds the limit of {self.most_torque:g} N m")
            self.end = Outcome("aborted", "force_limit", f"{what} after {1e3 * self.sample.measured[2]:.2f} mm")
            self._low, self._last = max(0.0, float(self._offset[2]) - BACK_OFF), self.sample

    def _advance(self, limiter: Limiter, elapsed: float, share: float) -> tuple[Array, Array]:
        if self._backing:
            relieved = float(np.linalg.norm(self.sample.newest[:3])) < RELIEVED * self.most_force
            if self._offset[2] - BACK_OFF_SPEED * STOPPING_TIME <= self._low or relieved:
                self._backing, self._low = False, np.inf
                return limiter.brake(elapsed)
            v = along(-BACK_OFF_SPEED)
        else:
            decided = self._law.velocity(self.sample, elapsed)
            if isinstance(decided, Outcome):
                self.end, self._last = decided, self.sample
                return limiter.brake(elapsed)
            v = share * decided
        self._time += elapsed
        self._offset = self._offset + v * elapsed
        error = self._offset - self._offset_of(limiter.position)
        if np.linalg.norm(error[:3]) > LINE or np.linalg.norm(error[3:]) > TURN:
            self.end = Outcome("aborted", "not_followed", "the joints cannot follow the tool's line: a joint is at its "
                                                           "limit, or the arm near a singular pose")
            return limiter.brake(elapsed)
        dq = self._joint_velocity(limiter.position, v + GAIN * error)
        dq = dq / max(float((np.abs(dq) / self._limits.velocity).max()), 1.0)
        return limiter.go_at(dq, elapsed)

    def _at_rest(self, goal: Goal, now: float) -> None:
        """Back off after the hard limit; else end the goal."""
        if not goal.stopping and self._low < np.inf and self._offset[2] > self._low:
            self._backing = True
        elif goal.ended is None:
            goal.ended = now

    # --- kinematics -----------------------------------------------------------------------------------------------

    def _offset_of(self, q: Array) -> Array:
        """Return the offset (6,) of the contact point at q (dof,) [rad], in the axes of the motion."""
        T = self._kinematics.fk(q)
        moved = T[:3, 3] + T[:3, :3] @ self._arm - self._origin
        turned = _rotation_vector(T[:3, :3] @ self._T0[:3, :3].T)
        return np.concatenate([self._axes.T @ moved, self._axes.T @ turned])

    def _jacobian(self, q: Array) -> Array:
        """Return the Jacobian (6, dof) of the contact point along the axes of world."""
        jacobian = self._kinematics.jacobian(q)
        x, y, z = self._kinematics.fk(q)[:3, :3] @ self._arm
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.concatenate([jacobian[:3] - cross @ jacobian[3:], jacobian[3:]])

    def _twist(self, v: Array) -> Array:
        return np.concatenate([self._axes @ v[:3], self._axes @ v[3:]])

    def _joint_velocity(self, q: Array, v: Array) -> Array:
        """Return joint velocities (dof,) [rad/s] for a velocity (6,) in the axes of the motion."""
        jacobian = self._jacobian(q)
        inverse = _inverse(jacobian)
        share = float(np.clip(self._offset[2] / self._request.max_distance, 0.0, 1.0)) * (SAMPLES - 1)
        low = min(int(share), SAMPLES - 2)
        posture = self.line[low] + (share - low) * (self.line[low + 1] - self.line[low])
        free = np.eye(len(q)) - inverse @ jacobian
        return np.asarray(inverse @ self._twist(v) + free @ (POSTURE_GAIN * (posture - q)))


def _axes(d: Array) -> Array:
    """Return axes (3, 3) whose third is the direction d (3,)."""
    aside = np.eye(3)[int(np.argmin(np.abs(d)))]
    x = np.cross(aside, d)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(d, x), d])


def _inverse(jacobian: Array) -> Array:
    left, values, right = np.linalg.svd(jacobian, full_matrices=False)
    return np.asarray((right.T * (values / (values**2 + DAMPING**2))) @ left.T)


def _rotation_vector(R: Array) -> Array:
    """Return the rotation vector (3,) [rad] of a small rotation (3, 3)."""
    vector = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    size = float(np.linalg.norm(vector))
    angle = float(np.arctan2(size, (np.trace(R) - 1) / 2))
    return np.asarray(vector if size < 1e-9 else vector * (angle / size))
