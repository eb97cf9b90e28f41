"""The proof of a chunk: what of it the arm executes, as one motion that ends at rest and is checked as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from applications.policy.interface import MotionState, ProvedMotion, Violation
from applications.policy.proof_motion import (
    Excess,
    Stops,
    braked,
    excess_of,
    first_excess,
    fitted,
    slowed_times,
    stops_from,
)
from applications.policy.proof_space import Found, Space
from common.control.goals import blend_time
from common.hardware.interface import Limits
from common.messages import Box, PlanningScene
from common.planning.point_obstacles import PointObstacle
from common.planning.trajectory import TimedPath, cubics
from common.robot.model import RobotModel

Array = NDArray[np.float64]
OnViolation = Literal["shorten", "slow", "refuse"]

MAX_ROWS = 300  # of a chunk
MAX_SECONDS = 60.0  # that a chunk may take
_FADES = (0.0, 0.15, 0.3, 0.5)  # [s] in which the state's difference from the rows fades; the shortest that works
_JUMP_FADE = 0.3  # [s] in which it must be able to fade at half of the limits
_INSET = 2e-3  # [rad] rows nearer to a position limit, or this much beyond it, are moved to this distance
_SLOWEST = 10.0  # factor by which a chunk is slowed down at most
_SLOW_RAMP = 0.3  # [s] in which the motion slows down
_SLOW_TRIES, _SLOW_REFINED = 8, 3
_BRAKED_STEP = 0.01  # [rad] between positions of a stop in which each joint brakes on its own


@dataclass(frozen=True)
class ProofOptions:
    """What is required of a motion.

    Attributes:
        on_violation: `shorten`: execute the longest prefix that is proved. `slow`: follow all rows more slowly if the
            limits of velocity, acceleration or jerk are exceeded, else as `shorten`. `refuse`: execute nothing.
        region: that the TCP stays in, poses in world [m]; None: anywhere.
        clearance: distance of the robot, and of what it holds, from everything else [m].
        acceleration: share of the acceleration limits that following the rows may use, 0 to 1; stops may use all.
    """

    on_violation: OnViolation = "shorten"
    region: Box | None = None
    clearance: float = 0.005
    acceleration: float = 0.95


class ChunkProver:
    """Proves motions for chunks of joint positions. Not thread-safe; the robot model belongs to it.

    A proved motion starts with the state at the join, without a jump of position, velocity or acceleration, follows the
    rows as a smooth spline and brakes to rest. All of it keeps the limits of position, velocity, acceleration and jerk,
    stays in the region, and is free of collision as a swept motion. Gripper links may touch perceived objects; an
    attached object may touch what it touches when it is attached, until the TCP is 20 mm away from there.

    A stop stays possible everywhere. Braking along the path is proved by construction: the path to its end at rest is
    free, and a slower motion along it visits the same positions. Stops that leave the path are checked from each knot
    of the spline, which are at most as far apart as the rows: with all joints at rest at the same time (proved as the
    motion is), and with each joint braking on its own at its deceleration limit (collision only, in small steps).
    """

    def __init__(self, robot: RobotModel, limits: Limits, options: ProofOptions | None = None) -> None:
        """Prove motions of a robot within limits, after `set_scene`."""
        self._robot, self._limits = robot, limits
        self.options = options or ProofOptions()
        self._space = Space(robot, self.options.region, self.options.clearance)

    def set_options(self, options: ProofOptions) -> None:
        """Apply other options from the next chunk on; another clearance from the next scene on."""
        self.options = options
        self._space.clearance = options.clearance
        self._space.set_region(options.region)

    def set_scene(
        self, scene: PlanningScene, positions: ArrayLike, points: Sequence[PointObstacle] = (),
        width: float | None = None,
    ) -> None:
        """Prove motions among these solids and points from now on.

        Args:
            scene: obstacles and attached objects.
            positions: (dof,) [rad] where the arm is; decides which contacts a newly attached object may have.
            points: what cameras saw and the scene does not have.
            width: of the gripper [m], the widest if it moves; None: as in the robot file.

        Raises:
            ProverUnavailable: the kernel is missing or does not support a shape.
            InvalidShape: a solid has no volume.
        """
        self._space.set_scene(scene, positions, points, width)

    def prove(self, state: MotionState, rows: object, times: object) -> ProvedMotion:
        """Return what of a chunk is executed: always a motion that is proved as a whole.

        Without a proved row it is the stop from the state, and empty if that is not proved either: then the motion that
        runs is to be continued.

        Args:
            state: of the set-points at the join.
            rows: (n, dof) [rad]; may be anything.
            times: (n,) [s] after the join, increasing; may be anything.

        Raises:
            RuntimeError: no scene was set.
            ValueError: the state is not one of this arm.
        """
        _ = self._space.world
        for values in (state.positions, state.velocities, state.accelerations):
            if values.shape != (self._robot.dof,) or not np.isfinite(values).all():
                raise ValueError(f"the state of the set-points has {values} for {self._robot.dof} joints")
        checked = self._checked(rows, times)
        if isinstance(checked, Violation):
            return self._stopped(state, checked)
        q, t = checked
        q, t, violation = self._within_limits(state, q, t)
        if violation is None or (self.options.on_violation != "refuse" and len(q)):
            violation = self._jump(state, q, t) or violation
            if violation is None or violation.cause != "jump":
                return self._follow(state, q, t, violation)
        return self._stopped(state, violation)

    # --- numbers ---

    def _checked(self, rows: object, times: object) -> tuple[Array, Array] | Violation:
        """Return rows and times as arrays, or what is wrong with them."""
        dof = self._robot.dof
        try:
            given = np.asarray(rows), np.asarray(times)
        except ValueError:  # rows of different lengths
            given = (np.empty(0, dtype=object),) * 2
        if any(values.dtype.kind not in "fiu" for values in given):
            return Violation("shape", "rows", 0.0, "the chunk is no array of real numbers")
        with np.errstate(all="ignore"):
            q, t = (values.astype(float) for values in given)
        if q.ndim != 2 or q.shape[1] != dof or not 1 <= len(q) <= MAX_ROWS or t.shape != (len(q),):
            message = f"the chunk has shape {q.shape} with {t.shape} times, not (1 to {MAX_ROWS}, {dof})"
            return Violation("shape", "rows", 0.0, message)
        if not np.isfinite(t).all():
            return Violation("not_finite", "times", 0.0, "a time of the chunk is not finite")
        if not np.isfinite(q).all():
            row, joint = np.argwhere(~np.isfinite(q))[0]
            name = self._robot.joint_names[joint]
            return Violation("not_finite", name, float(max(t[row], 0.0)), f"row {row}: {name} is {q[row, joint]}")
        if not (t[0] > 1e-6 and t[-1] <= MAX_SECONDS and (np.diff(t) > 5e-4).all()):
            message = f"the times of the chunk do not increase by 0.5 ms or more from above 0 to {MAX_SECONDS:g} s"
            return Violation("shape", "times", 0.0, message)
        return q, t

    def _within_limits(self, state: MotionState, q: Array, t: Array) -> tuple[Array, Array, Violation | None]:
        """Return the rows before one beyond a position limit, a little moved in, and that violation."""
        lower, upper = self._bounds(state)
        outside = (q < lower - _INSET) | (q > upper + _INSET)
        violation = None
        if outside.any():
            row, joint = (int(i) for i in np.argwhere(outside)[0])
            name = self._robot.joint_names[joint]
            limits = f"{lower[joint]:.3f} to {upper[joint]:.3f} rad"
            message = f"row {row}: {name} at {q[row, joint]:.4g} rad is not within {limits}"
            violation = Violation("position", name, float(t[row]), message)
            q, t = q[:row], t[:row]
        return np.clip(q, lower + _INSET, upper - _INSET), t, violation

    def _bounds(self, state: MotionState) -> tuple[Array, Array]:
        """Return position limits (dof,) [rad]; a joint beyond a limit has no more room than that."""
        return np.minimum(self._limits.lower, state.positions), np.maximum(self._limits.upper, state.positions)

    def _jump(self, state: MotionState, q: Array, t: Array) -> Violation | None:
        """Return that the rows start farther from the state than can fade in time."""
        slope = (q[1] - q[0]) / (t[1] - t[0]) if len(q) > 1 else state.velocities
        off = np.minimum(np.abs(q[0] - slope * t[0] - state.positions),
                         np.abs(q[0] - state.velocities * t[0] - state.positions))
        if blend_time(off, 0.0, self._limits) <= _JUMP_FADE:
            return None
        joint = int(np.argmax(off))
        name = self._robot.joint_names[joint]
        message = f"the chunk starts {off[joint]:.3f} rad away from {name}'s set-point"
        return Violation("jump", name, float(t[0]), message)

    # --- the motion ---

    def _follow(self, state: MotionState, q: Array, t: Array, violation: Violation | None) -> ProvedMotion:
        """Return the motion for rows within position limits, `violation` of which ended them."""
        path, excess, fade = self._smooth(state, q, t)
        slowed, moved, reason = 1.0, t, None
        if excess is not None and self.options.on_violation == "slow" and excess.cause != "position":
            found = self._slow(state, q, t, fade, excess)
            if found is not None:
                reason = self._exceeded(path, excess)
                path, slowed, moved = found
                excess = None
        last = len(path.times) - 1
        if excess is not None:
            violation, last = self._exceeded(path, excess), excess.piece
        stops = self._stops(path, last)
        last, violation = self._free(state, path, stops, last, violation)
        violation = violation or reason
        if violation is not None and self.options.on_violation == "refuse":
            last = min(last, 0)
        if last < 0:
            return self._empty(violation)
        moving = float(path.times[last])
        rows = int(np.searchsorted(moved, moving + 1e-6))
        return ProvedMotion(*_joined(path, last, stops.one(last)), moving, rows, slowed, violation)

    def _smooth(self, state: MotionState, q: Array, t: Array) -> tuple[TimedPath, Excess | None, float]:
        """Return the spline through rows that keeps the limits longest, what it exceeds, and how long it blends."""
        best: tuple[TimedPath, Excess | None, float] | None = None
        for fade in _FADES:
            path = fitted(state, q, t, fade)
            excess = self._excess(state, path)
            if excess is None:
                return path, None, fade
            if best is None or best[1] is None or path.times[excess.piece] > best[0].times[best[1].piece] + 1e-9:
                best = path, excess, fade
            if path.times[excess.piece] > 2 * _FADES[-1]:
                break  # blending does not change it
        assert best is not None
        return best

    def _excess(self, state: MotionState, path: TimedPath) -> Excess | None:
        full = self._limits.acceleration
        most = np.minimum(np.maximum(self.options.acceleration * full, np.abs(state.accelerations)), full)
        return excess_of(path, self._limits, most, *self._bounds(state))

    def _slow(
        self, state: MotionState, q: Array, t: Array, fade: float, excess: Excess
    ) -> tuple[TimedPath, float, Array] | None:
        """Return a spline that keeps the limits along the same rows, how much slower it is, and the rows' times."""
        slope = (q[0] - state.positions) / t[0] if len(q) == 1 else (q[1] - q[0]) / (t[1] - t[0])
        weight = slope / self._limits.velocity**2
        first = float(np.clip(state.velocities @ weight / max(float(slope @ weight), 1e-9), 0.0, 1.0))

        def slower(factor: float) -> tuple[TimedPath, Array, Excess | None]:
            later = slowed_times(t, factor, _SLOW_RAMP, first)
            path = fitted(state, q, later, fade)
            return path, later, self._excess(state, path)

        low, factor = 1.0, min(max(excess.slowing, 1.02), _SLOWEST)
        path, later, over = slower(factor)
        for _ in range(_SLOW_TRIES):
            if over is None or over.cause == "position" or factor >= _SLOWEST:
                break
            low, factor = factor, min(factor * min(max(over.slowing, 1.05), 2.0), _SLOWEST)
            path, later, over = slower(factor)
        if over is not None:
            return None
        found = path, factor, later
        for _ in range(_SLOW_REFINED):
            factor = float(np.sqrt(low * found[1]))
            path, later, over = slower(factor)
            if over is None:
                found = path, factor, later
            else:
                low = factor
        return found

    def _stops(self, path: TimedPath, last: int) -> Stops:
        n = last + 1
        states = path.positions[:n], path.velocities[:n], path.accelerations[:n]
        return stops_from(*states, self._limits.acceleration, self._limits.jerks)

    # --- what is around ---

    def _free(
        self, state: MotionState, path: TimedPath, stops: Stops, last: int, violation: Violation | None
    ) -> tuple[int, Violation | None]:
        """Return the last knot from which the stop ends a proved motion, -1 for none, and why no later one does."""
        pieces = cubics(path)[:last] if last else np.zeros((0, 4, self._robot.dof))
        found = self._space.leaves_region(pieces)
        if found is not None:
            last, violation = int(found.where), _violation("region", path, found)
        found = self._space.hit(pieces[:last])
        if found is not None:
            last, violation = int(found.where), _violation("collision", path, found)
        stop = self._no_stop(state, stops, last + 1)
        if stop is not None:
            knot, what, why = stop
            at, last = float(path.times[knot]), knot - 1
            message = f"the arm could not stop any more after {at:.2f} s: {why}"
            violation = violation or Violation("stop", what, at, message)
        return last, violation

    def _no_stop(self, state: MotionState, stops: Stops, count: int) -> tuple[int, str, str] | None:
        """Return the first of `count` states whose stops are not proved, the joint, side or pair, and a reason."""
        answer: tuple[int, str, str] | None = None
        excess = first_excess(
            stops.spans[: 3 * count], stops.cubics()[: 3 * count], self._limits, self._limits.acceleration,
            *self._bounds(state))
        if excess is not None:
            name, count = self._robot.joint_names[excess.joint], excess.piece // 3
            answer = count, name, f"{name} would exceed its {excess.cause} limit"
        curves = stops.curves()
        for check in (self._space.leaves_region, self._space.hit):
            found = check(curves[: 2 * count])
            if found is not None:
                count = int(found.where) // 2
                answer = count, found.what, found.message
        positions, velocities = stops.positions[:count, 0], stops.velocities[:count, 0]
        states, owners = braked(positions, velocities, self._limits.braking, _BRAKED_STEP)
        found = self._space.hit_at(states)
        if found is not None:
            answer = int(owners[int(found.where)]), found.what, found.message
        return answer

    # --- answers ---

    def _exceeded(self, path: TimedPath, excess: Excess) -> Violation:
        name, at = self._robot.joint_names[excess.joint], float(path.times[excess.piece])
        return Violation(excess.cause, name, at, f"{name} would exceed its {excess.cause} limit after {at:.2f} s")

    def _stopped(self, state: MotionState, violation: Violation | None) -> ProvedMotion:
        """Return the stop from the state, if it is proved."""
        path = TimedPath(np.zeros(1), state.positions[None], state.velocities[None], state.accelerations[None])
        stops = self._stops(path, 0)
        if self._no_stop(state, stops, 1) is not None:
            return self._empty(violation)
        stop = stops.one(0)
        return ProvedMotion(
            stop.times, stop.positions, stop.velocities, stop.accelerations, 0.0, 0, violation=violation)

    def _empty(self, violation: Violation | None) -> ProvedMotion:
        none = np.zeros((0, self._robot.dof))
        return ProvedMotion(np.zeros(0), none, none, none, 0.0, 0, violation=violation)


def _violation(cause: Literal["region", "collision"], path: TimedPath, found: Found) -> Violation:
    """Return what was found on the cubics of a path."""
    at = float(np.interp(found.where, np.arange(len(path.times)), path.times))
    return Violation(cause, found.what, at, f"{found.message} after {at:.2f} s")


def _joined(path: TimedPath, last: int, stop: TimedPath) -> tuple[Array, Array, Array, Array]:
    """Return times and states of a path up to its last knot, and the stop from there."""
    return (
        np.concatenate([path.times[: last + 1], path.times[last] + stop.times[1:]]),
        np.concatenate([path.positions[: last + 1], stop.positions[1:]]),
        np.concatenate([path.velocities[: last + 1], stop.velocities[1:]]),
        np.concatenate([path.accelerations[: last + 1], stop.accelerations[1:]]),
    )
