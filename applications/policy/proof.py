"""The proof of a chunk: what of it the arm executes, as one motion that ends at rest and is checked as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from applications.policy.interface import MotionState, ProvedMotion, Violation
from applications.policy.proof_motion import Excess, Stops, excess_of, first_excess, fitted, slowed_times, stops_from
from common.control.goals import blend_time
from common.errors import ZencellError
from common.hardware.interface import Limits
from common.messages import Box, PathConstraints, PlanningScene
from common.planning.collision import CollisionWorld
from common.planning.constraints import ToolConstraints
from common.planning.contact_rules import PERCEIVED, Pair
from common.planning.obstacles import ObstacleCache
from common.planning.point_obstacles import PointObstacle
from common.planning.robot_geometry import RobotGeometry
from common.planning.trajectory import TimedPath, cubics, sample
from common.robot.model import RobotModel

Array = NDArray[np.float64]
OnViolation = Literal["shorten", "slow", "refuse"]

MAX_ROWS = 300  # of a chunk
MAX_SECONDS = 60.0  # that a chunk may take
_FADES = (0.0, 0.15, 0.3)  # [s] in which a difference between the state and the rows fades; the shortest that works
_INSET = 2e-3  # [rad] rows nearer to a position limit, or this much beyond it, are moved to this distance
_SLOWEST = 10.0  # factor by which a chunk is slowed down at most
_SLOW_RAMP = 0.15  # [s] in which the motion slows down
_SLOW_TRIES, _SLOW_REFINED = 8, 3
_REGION_SHARES = (0.0, 0.5)  # of the tolerance of a region that states may use, and that is proved between them
_STEP = 0.005  # [rad] between states where the kernel cannot check what an attached object touches


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


class ProverUnavailable(ZencellError):
    """The compiled kernel, which proves that motions are free, is missing or does not support the robot or a shape."""


class ChunkProver:
    """Proves motions for chunks of joint positions. Not thread-safe; the robot model belongs to it.

    A proved motion starts with the state at the join, without a jump of position, velocity or acceleration, follows the
    rows as a smooth spline and brakes to rest. All of it keeps the limits of position, velocity, acceleration and jerk,
    stays in the region, and is free of collision as a swept motion. Gripper links may touch perceived objects; an
    attached object may touch what it touches when it is attached, until the TCP is 20 mm away from there.

    A stop stays possible everywhere. Braking along the path is proved by construction: the path to its end at rest is
    free, and a slower motion along it visits the same positions. Stops of the arm that leave the path, with all joints
    at rest at the same time, are checked from each knot of the spline, which are at most as far apart as the rows.
    """

    def __init__(self, robot: RobotModel, limits: Limits, options: ProofOptions | None = None) -> None:
        """Prove motions of a robot within limits, after `set_scene`."""
        self._robot, self._limits = robot, limits
        self._cache = ObstacleCache(RobotGeometry(robot))
        self._world: CollisionWorld | None = None
        self._region = ToolConstraints.none(robot)
        self._attached: tuple[tuple[str, ...], Array] | None = None
        self.set_options(options or ProofOptions())

    def set_options(self, options: ProofOptions) -> None:
        """Apply other options from the next chunk on; another clearance from the next scene on."""
        self.options = options
        requested = PathConstraints(region=options.region)
        self._region = ToolConstraints(self._robot, requested, np.zeros(self._robot.dof))
        self._attach_region()

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
        names = tuple(item.object.id for item in scene.attached)
        if self._attached is None or self._attached[0] != names:
            self._attached = names, np.array(positions, dtype=float)
        gripper = self._robot.config.gripper
        touchable = [item.id for item in scene.objects if item.role in PERCEIVED]
        allowed = [(link, name) for link in (gripper.links if gripper else []) for name in touchable]
        self._world = CollisionWorld(
            self._robot, scene, start=self._attached[1], clearance=self.options.clearance, allowed=allowed,
            cache=self._cache, points=points, width=width)
        if self._world.kernel is None:
            self._world = None
            raise ProverUnavailable("the planning kernel is not built, or does not support a shape of this cell")
        self._attach_region()

    def _attach_region(self) -> None:
        if self._world is not None and self._world.kernel is not None:
            self._region.attach_to_kernel(self._world.kernel)

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
        """
        if self._world is None:
            raise RuntimeError("set_scene() must be called before prove()")
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
            with np.errstate(all="ignore"):
                q, t = np.array(rows, dtype=float), np.array(times, dtype=float)
        except (TypeError, ValueError, OverflowError):
            return Violation("shape", "rows", 0.0, "the chunk is no array of numbers")
        if q.ndim != 2 or q.shape[1] != dof or not 1 <= len(q) <= MAX_ROWS or t.shape != (len(q),):
            message = f"the chunk has shape {q.shape} with {t.shape} times, not (1 to {MAX_ROWS}, {dof})"
            return Violation("shape", "rows", 0.0, message)
        if not np.isfinite(t).all():
            return Violation("not_finite", "times", 0.0, "a time of the chunk is not finite")
        if not np.isfinite(q).all():
            row, joint = np.argwhere(~np.isfinite(q))[0]
            name = self._robot.joint_names[joint]
            return Violation("not_finite", name, float(max(t[row], 0.0)), f"row {row}: {name} is {q[row, joint]}")
        if not (t[0] > 1e-6 and t[-1] <= MAX_SECONDS and (np.diff(t) > 1e-3).all()):
            return Violation("shape", "times", 0.0, "the times of the chunk do not increase by 1 ms or more from above "
                             f"0 to at most {MAX_SECONDS:g} s")
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
        if blend_time(off, 0.0, self._limits) <= _FADES[-1]:
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
        low, factor = 1.0, min(max(excess.slowing, 1.02), _SLOWEST)
        found: tuple[TimedPath, float, Array] | None = None
        for _ in range(_SLOW_TRIES):
            later = slowed_times(t, factor, _SLOW_RAMP)
            path = fitted(state, q, later, fade)
            over = self._excess(state, path)
            if over is None:
                found = path, factor, later
                break
            if factor >= _SLOWEST or over.cause == "position":
                return None
            low, factor = factor, min(factor * min(max(over.slowing, 1.05), 2.0), _SLOWEST)
        for _ in range(_SLOW_REFINED if found is not None else 0):
            assert found is not None
            factor = float(np.sqrt(low * found[1]))
            later = slowed_times(t, factor, _SLOW_RAMP)
            path = fitted(state, q, later, fade)
            if self._excess(state, path) is None:
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
        outside = self._region.first_violation(pieces, _REGION_SHARES) if last else None
        if outside is not None:
            last, violation = outside[0], self._left_region(path, *outside)
        hit = self._hit(pieces[:last]) if last else None
        if hit is not None:
            last, (where, pair) = int(hit[0]), hit
            at = float(np.interp(where, np.arange(len(path.times)), path.times))
            message = f"{pair[0]} would touch {pair[1]} after {at:.2f} s"
            violation = Violation("collision", " - ".join(pair), at, message)
        stopping = stops.cubics()[: 3 * (last + 1)]
        found = self._stop_violation(state, stops, stopping)
        if found is not None:
            knot, what, why = found
            at, last = float(path.times[knot]), knot - 1
            violation = violation or Violation(
                "stop", what, at, f"a stop after {at:.2f} s would not be possible: {why}")
        return last, violation

    def _stop_violation(self, state: MotionState, stops: Stops, pieces: Array) -> tuple[int, str, str] | None:
        """Return the first stop that is not proved, the joint, side or pair, and a reason."""
        found: tuple[int, str, str] | None = None
        spans = np.diff(stops.times, axis=1).reshape(-1)[: len(pieces)]
        excess = first_excess(spans, pieces, self._limits, self._limits.acceleration, *self._bounds(state))
        if excess is not None:
            name = self._robot.joint_names[excess.joint]
            found = excess.piece // 3, name, f"{name} would exceed its {excess.cause} limit"
            pieces = pieces[: 3 * found[0]]
        outside = self._region.first_violation(pieces, _REGION_SHARES) if len(pieces) else None
        if outside is not None:
            side = self._side(_at(pieces, outside[0] + outside[1]))
            found = outside[0] // 3, side, f"the TCP would leave the region at {side}"
            pieces = pieces[: 3 * found[0]]
        hit = self._hit(pieces) if len(pieces) else None
        if hit is not None:
            found = int(hit[0]) // 3, " - ".join(hit[1]), f"{hit[1][0]} would touch {hit[1][1]}"
        return found

    def _hit(self, pieces: Array) -> tuple[float, Pair] | None:
        """Return the first collision of cubics (N, 4, dof): index and share of the cubic, and the pair."""
        world = self._world
        assert world is not None and world.kernel is not None
        proved, hit = world.check_cubics(pieces)
        if proved:
            return None
        index, where = world.kernel.cubics_collision(pieces)
        if index >= 0:
            return min(where, len(pieces) - 1e-9), hit.pair if hit is not None else world.pair(index)
        for number, piece in enumerate(pieces):  # something held touches what only coal can check
            count = max(1, int(np.ceil(np.abs(piece[1:]).sum(axis=0).max() / _STEP)))
            r = np.linspace(0.0, 1.0, count + 1)[:, None]
            states = piece[0] + r * (piece[1] + r * (piece[2] + r * piece[3]))
            touched = world.first_collision(states)
            if touched is not None:
                return number + touched.index / (count + 1), touched.pair
        return None

    def _side(self, q: Array) -> str:
        """Return the side of the region that the TCP is outside of at q."""
        values = self._region.bounds.n @ self._robot.fk(q)[:3, 3] - self._region.bounds.least
        axis, inwards = divmod(int(np.argmin(values)), 2)
        return f"{'+' if inwards else '-'}{'xyz'[axis]}"

    # --- answers ---

    def _exceeded(self, path: TimedPath, excess: Excess) -> Violation:
        name, at = self._robot.joint_names[excess.joint], float(path.times[excess.piece])
        return Violation(excess.cause, name, at, f"{name} would exceed its {excess.cause} limit after {at:.2f} s")

    def _left_region(self, path: TimedPath, piece: int, where: float) -> Violation:
        at = float(np.interp(piece + where, np.arange(len(path.times)), path.times))
        side = self._side(sample(path, [at])[0])
        return Violation("region", side, at, f"the TCP would leave its region at {side} after {at:.2f} s")

    def _stopped(self, state: MotionState, violation: Violation | None) -> ProvedMotion:
        """Return the stop from the state, if it is proved."""
        path = TimedPath(np.zeros(1), state.positions[None], state.velocities[None], state.accelerations[None])
        stops = self._stops(path, 0)
        if self._stop_violation(state, stops, stops.cubics()) is not None:
            return self._empty(violation)
        stop = stops.one(0)
        return ProvedMotion(
            stop.times, stop.positions, stop.velocities, stop.accelerations, 0.0, 0, violation=violation)

    def _empty(self, violation: Violation | None) -> ProvedMotion:
        none = np.zeros((0, self._robot.dof))
        return ProvedMotion(np.zeros(0), none, none, none, 0.0, 0, violation=violation)


def _at(pieces: Array, where: float) -> Array:
    piece = min(int(where), len(pieces) - 1)
    return np.asarray((where - piece) ** np.arange(4) @ pieces[piece])


def _joined(path: TimedPath, last: int, stop: TimedPath) -> tuple[Array, Array, Array, Array]:
    """Return times and states of a path up to its last knot, and the stop from there."""
    return (
        np.concatenate([path.times[: last + 1], path.times[last] + stop.times[1:]]),
        np.concatenate([path.positions[: last + 1], stop.positions[1:]]),
        np.concatenate([path.velocities[: last + 1], stop.velocities[1:]]),
        np.concatenate([path.accelerations[: last + 1], stop.accelerations[1:]]),
    )
