"""Tool constraints along a path: upright within an angle, inside a box. Proved along curves, not sampled.

Each is a number n x - least, of a tool direction or of the tool centre point x, that must not be negative. Along a
curve it is at least s0 + v (t - t0) - K (t - t0)^2 / 2 and s0 - M |t - t0|, with s0 and v at t0 and bounds K, M on the
second and the first derivative along the complete curve, as in the proof that an edge is free (docs/planning.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.messages import PathConstraints
from common.planning.kernel.world import KernelWorld
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix

Array = NDArray[np.float64]

TILT_TOLERANCE = 1e-3  # [rad] by which a trajectory may exceed the angle, and
PLACE_TOLERANCE = 1e-4  # [m] leave the box, anywhere on it
# Shares of the tolerances that planners, and then the final check, use up: at states, and between them.
PLANNING_SHARES = (0.25, 0.5)
VALIDATION_SHARES = (0.5, 1.0)
_PROJECTED_TILT = 0.8  # of the angle, and
_PROJECTED_DEPTH = 0.01  # [m] inside the box: where states that violate a constraint are projected to
_MAX_EVALUATIONS = 20_000  # on one curve; what is not proved then counts as a violation


@dataclass(frozen=True)
class Bounds:
    """Numbers n x - least that must not be negative, of tool directions or of the tool centre point.

    Attributes:
        directions: (B,) whether x is a direction fixed to the tool, else the tool centre point.
        at: (B, 3) that direction in the tool's frame; n: (B, 3) unit, world; least, slack: (B,), slack is what n x may
            fall short by at the tolerance.
        inside: (B,) where states are projected to: an angle [rad] between both, or n x - least [m].
    """

    directions: NDArray[np.bool_]
    at: Array
    n: Array
    least: Array
    slack: Array
    inside: Array


class ToolConstraints:
    """Tilt and region of one request on one robot; the timing of a path limits the tool's speed."""

    def __init__(self, robot: RobotModel, requested: PathConstraints, start: Array) -> None:
        """Copy a message; `start` (dof,) [rad] defines upright if the message says "as at the start"."""
        self.robot = robot
        self.tilt = requested.tilt
        self.tool_speed = requested.tool_speed
        self._kernel: KernelWorld | None = None
        rows: list[tuple[bool, Array, Array, float, float, float]] = []
        if requested.tilt is not None:
            up = _unit(requested.axis)
            axis = robot.fk(start)[:3, :3].T @ up if requested.upright_at_start else _unit(requested.tool_axis)
            self._up, self._tool_axis = up, axis
            slack = math.cos(requested.tilt) - math.cos(min(requested.tilt + TILT_TOLERANCE, math.pi))
            if slack > 0:
                rows.append((True, axis, up, math.cos(requested.tilt), slack, _PROJECTED_TILT * requested.tilt))
        if requested.region is not None:
            T, size = pose_to_matrix(requested.region.pose), requested.region.size
            for number, side in enumerate((size.x, size.y, size.z)):
                for n in (T[:3, number], -T[:3, number]):
                    inside = min(_PROJECTED_DEPTH, side / 8)
                    rows.append((False, np.zeros(3), n, float(n @ T[:3, 3]) - side / 2, PLACE_TOLERANCE, inside))
        self.bounds = Bounds(
            np.array([row[0] for row in rows], dtype=bool),
            np.array([row[1] for row in rows]).reshape(-1, 3),
            np.array([row[2] for row in rows]).reshape(-1, 3),
            np.array([row[3] for row in rows], dtype=float),
            np.array([row[4] for row in rows], dtype=float),
            np.array([row[5] for row in rows], dtype=float),
        )
        self._turns = np.array([not joint.shortname().startswith("JointModelP") for joint in robot.model.joints[1:]])
        self._levers = _levers(robot)

    @classmethod
    def none(cls, robot: RobotModel) -> ToolConstraints:
        """Return constraints without any bound."""
        return cls(robot, PathConstraints(), np.zeros(robot.dof))

    @property
    def has_bounds(self) -> bool:
        """Whether the path is constrained at all, apart from the speed."""
        return len(self.bounds.n) > 0

    def attach_to_kernel(self, kernel: KernelWorld) -> None:
        """Set the bounds in the compiled kernel, and let it check curves from now on."""
        frame = self.robot.model.frames[self.robot.tcp_frame]
        b, placement = self.bounds, frame.placement
        kernel.set_bounds(
            frame.parentJoint, np.array(placement.translation), b.directions, b.at @ np.array(placement.rotation).T,
            b.n, b.least, b.slack, b.inside,
        )
        self._kernel = kernel

    def holds(self, q: ArrayLike, share: float = PLANNING_SHARES[0]) -> bool:
        """Return whether the robot at q (dof,) [rad] meets all bounds, up to a share of the tolerances."""
        bounds = self.bounds
        return not self.has_bounds or bool((self._values(self.robot.fk(q)) >= -share * bounds.slack).all())

    def pose_violation(
        self, T_world_tcp: Array, turn: float = 0.0, travel: float = 0.0, share: float = PLANNING_SHARES[0]
    ) -> str:
        """Return what a pose (4, 4) violates by more than a turn [rad] and travel [m] could correct; "" for nothing."""
        if self.tilt is not None:
            tilt = math.acos(float(np.clip(self._up @ T_world_tcp[:3, :3] @ self._tool_axis, -1, 1)))
            if tilt - turn > self.tilt + share * TILT_TOLERANCE:
                return f"the tool is tilted by {tilt:.4g} rad, {self.tilt:.4g} allowed"
        values = self._values(T_world_tcp)[~self.bounds.directions]
        beyond = -float(values.min(initial=0.0))
        if beyond - travel > share * PLACE_TOLERANCE:
            return f"the tool centre point is {1e3 * beyond:.4g} mm outside its region"
        return ""

    def state_violation(self, q: ArrayLike, share: float = PLANNING_SHARES[0]) -> str:
        """Return what the robot violates at q (dof,) [rad]; "" for nothing."""
        return self.pose_violation(self.robot.fk(q), share=share)

    def edge_satisfies(self, a: Array, b: Array) -> bool:
        """Return whether the straight line in joint space from a to b (dof,) [rad] meets all bounds."""
        return self.first_violation(edge_cubic(a, b)) is None

    def edge_violation(self, a: Array, b: Array) -> str:
        """Return the first violation on the straight line from a to b (dof,) [rad]; "" for none."""
        violation = self.first_violation(edge_cubic(a, b))
        return self.describe_violation(a + violation[1] * (b - a)) if violation else ""

    def describe_violation(self, q: Array) -> str:
        """Return the violation at q (dof,) [rad], where one was found."""
        return self.state_violation(q, 0.0) or "the tool violates its constraints"

    def first_violation(self, cubics: Array, shares: tuple[float, float] = PLANNING_SHARES) -> tuple[int, float] | None:
        """Return the first piece, and t on it, at which cubics violate a bound; None if they meet all.

        Args:
            cubics: (N, 4, dof) [rad] c0 + c1 t + c2 t^2 + c3 t^3, t from 0 to 1.
            shares: of the tolerances that states may use, and that are proved between them.
        """
        if not self.has_bounds:
            return None
        if self._kernel is not None:
            return self._kernel.first_violation(cubics, *shares)
        for number, c in enumerate(cubics):
            t = self._violated_at(c, *shares)
            if t is not None:
                return number, t
        return None

    def _violated_at(self, c: Array, accepted: float, proved: float) -> float | None:
        M, K = self._rates(c)
        slack = self.bounds.slack
        t = 0.0
        for _ in range(_MAX_EVALUATIONS):
            q = c[0] + t * (c[1] + t * (c[2] + t * c[3]))
            dq = c[1] + t * (2 * c[2] + t * 3 * c[3])
            values, change = self._moving(q, dq)
            if not (values >= -accepted * slack).all():
                return t
            t += float(_time_to_zero(values + proved * slack, -change, K, M).min())
            if t >= 1:
                return None
        return t

    def _values(self, T: Array) -> Array:
        """Return (B,) the margin of each bound at a pose (4, 4) of the tool."""
        b = self.bounds
        x = np.where(b.directions[:, None], b.at @ T[:3, :3].T, T[:3, 3])
        return np.asarray((b.n * x).sum(axis=1) - b.least)

    def _moving(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Return (B,) the margin of each bound, and its rate at velocities dq."""
        robot, b = self.robot, self.bounds
        J = pin.computeFrameJacobian(
            robot.model, robot.data, q, robot.tcp_frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        T = np.array(pin.updateFramePlacement(robot.model, robot.data, robot.tcp_frame).homogeneous)
        twist = J @ dq
        turned = np.cross(twist[3:], b.at @ T[:3, :3].T)
        dx = np.where(b.directions[:, None], turned, twist[:3])
        return self._values(T), np.asarray((b.n * dx).sum(axis=1))

    def _rates(self, c: Array) -> tuple[Array, Array]:
        """Return (B,) M and K of each bound on one cubic (4, dof)."""
        ends = np.abs([c[1], c[1] + 2 * c[2] + 3 * c[3]])
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = np.where(c[3] != 0, -c[2] / (3 * c[3]), -1.0)
        inside = (turn > 0) & (turn < 1)
        middle = np.where(inside, np.abs(c[1] + turn * (2 * c[2] + 3 * c[3] * turn)), 0.0)
        speed = np.maximum(ends.max(axis=0), middle)
        bend = np.maximum(np.abs(2 * c[2]), np.abs(2 * c[2] + 6 * c[3]))
        turning = np.where(self._turns, speed, 0.0)
        before = np.cumsum(turning) - turning
        second = speed * (speed + 2 * before) + bend
        levers = np.where(self.bounds.directions[:, None], self._turns.astype(float), self._levers)
        return levers @ speed, levers @ second


def edge_cubic(a: Array, b: Array) -> Array:
    """Return (1, 4, dof) the straight line from a to b as a cubic."""
    rest = np.zeros_like(a)
    return np.stack([a, b - a, rest, rest])[None]


def _unit(v: object) -> Array:
    along = np.array([v.x, v.y, v.z])  # type: ignore[attr-defined]
    return np.asarray(along / np.linalg.norm(along))


def _time_to_zero(s0: Array, v: Array, K: Array, M: Array) -> Array:
    """Return how long s0 - v t - K t^2 / 2 or s0 - M t stays positive: the longer of both."""
    root = np.sqrt(v * v + 2 * K * s0)
    with np.errstate(divide="ignore", invalid="ignore"):
        curved = np.where(v > 0, 2 * s0 / (v + root), np.where(K > 1e-300, (root - v) / K, np.inf))
        plain = np.where(M > 1e-300, s0 / M, np.inf)
    return np.maximum(np.maximum(curved, plain), 0.0)


def _levers(robot: RobotModel) -> Array:
    """Return (dof,) the largest distance of the tool centre point from each joint's axis [m]; 1 for sliding joints."""
    model, frame = robot.model, robot.model.frames[robot.tcp_frame]
    levers = np.zeros(robot.dof)
    beyond, joint = float(np.linalg.norm(frame.placement.translation)), frame.parentJoint
    while joint:
        slides = model.joints[joint].shortname().startswith("JointModelP")
        i = model.joints[joint].idx_q
        levers[i] = 1.0 if slides else beyond
        beyond += float(np.linalg.norm(model.jointPlacements[joint].translation))
        beyond += max(abs(robot.lower[i]), abs(robot.upper[i])) if slides else 0.0
        joint = model.parents[joint]
    return levers
