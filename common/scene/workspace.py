"""Where the arm can grasp objects: bounds of the workspace, and the chain of poses of a grasp."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.config import Grasp, Parameters, Tunable, check
from common.planning.ik import controls_full_pose, explain_region_unreachable, pose_region, solve_tool_down_ik
from common.robot.model import RobotModel
from common.robot.transforms import tool_down

Array = npt.NDArray[np.float64]

# IK iterations: solutions are found within 12 from home, and within 4 from two centimetres away.
_FROM_HOME = 16
_FROM_NEAR = 8


class WorkspaceBounds(Parameters):
    """A cylindrical shell about the robot's base axis, and the resolution of the reach test within it."""

    min_height: Tunable[float] = Field(-0.05, ge=-5, le=5, description="lowest z of an object [m]")
    max_height: Tunable[float] = Field(0.98, ge=-5, le=5, description="highest z of an object [m]")
    min_radius: Tunable[float] = Field(0.18, ge=0, le=5, description="least horizontal distance from the base axis [m]")
    max_radius: Tunable[float] = Field(
        0.82, gt=0, le=5, description="largest horizontal distance from the base axis [m]"
    )
    singularity_radius: Tunable[float] = Field(
        0.08, ge=0, le=5, description="column about the base axis in which the wrist axes line up [m]"
    )
    yaw_count: Tunable[int] = Field(8, ge=1, le=36, description="gripper orientations tried, spread over half a turn")
    line_step: Tunable[float] = Field(0.02, gt=0, le=0.2, description="step of checks along straight lines [m]")
    max_joint_step: Tunable[float] = Field(
        0.5, gt=0, le=3.2, description="a joint that moves farther between two poses has changed branch [rad]"
    )

    @model_validator(mode="after")
    def _ordered(self) -> WorkspaceBounds:
        for low, high in (("min_height", "max_height"), ("min_radius", "max_radius")):
            if getattr(self, low) >= getattr(self, high):
                raise ValueError(f"{low} {getattr(self, low):g} is not below {high} {getattr(self, high):g}")
        return self


def configured_bounds(services: Mapping[str, Mapping[str, Any]]) -> WorkspaceBounds:
    """Return the workspace bounds of a cell: those of the first service that has such parameters.

    Args:
        services: parameters by service.

    Raises:
        ConfigError: names the invalid parameter.
    """
    for service, parameters in services.items():
        if values := {name: value for name, value in parameters.items() if name in WorkspaceBounds.model_fields}:
            return check(WorkspaceBounds, values, f"services.{service}")
    return WorkspaceBounds()


def out_of_bounds_reason(
    bounds: WorkspaceBounds, position: Sequence[float], base: Sequence[float] = (0.0, 0.0)
) -> str:
    """Return why a position (x, y, z) [m], world, is out of bounds, with value and bound; empty if it is within.

    The singularity column comes first: the least radius would hide it. The axis of the base is at x, y of `base`.
    """
    x, y, z = position
    radius = math.hypot(x - base[0], y - base[1])
    if radius < bounds.singularity_radius:
        return f"singularity column: {radius:.3f} m from the base axis, less than {bounds.singularity_radius:.3f} m"
    if z < bounds.min_height:
        return f"too low: height {z:.3f} m is below {bounds.min_height:.3f} m"
    if z > bounds.max_height:
        return f"too high: height {z:.3f} m is above {bounds.max_height:.3f} m"
    if radius < bounds.min_radius:
        return f"too close: {radius:.3f} m from the base axis, less than {bounds.min_radius:.3f} m"
    if radius > bounds.max_radius:
        return f"too far: {radius:.3f} m from the base axis, more than {bounds.max_radius:.3f} m"
    return ""


def grasp_chain_failure(
    robot: RobotModel, position: Sequence[float], grasp: Grasp, bounds: WorkspaceBounds, *, explained: bool = True
) -> str:
    """Return the stage of a grasp at (x, y, z) [m] that has no solution for any yaw; empty if one yaw has them all.

    The stages: pre-grasp above it, the straight line down, the grasp, the straight lift; tool down, from home. For an
    arm that cannot choose yaw and tilt, `explained` adds what it misses them by, after a long search.
    """
    furthest, worst = -1, ""
    for yaw in yaw_candidates(bounds.yaw_count) if controls_full_pose(robot) else (0.0,):
        stage, reason = _chain(robot, position, yaw, grasp, bounds)
        if not reason:
            return ""
        if stage > furthest:
            furthest, worst = stage, reason
    if controls_full_pose(robot) or not explained:
        return worst
    x, y, z = position
    low = grasp.height(z)
    T = tool_down(x, y, low + (grasp.approach_clearance, 0.0, 0.0, grasp.lift_height)[furthest])
    region = pose_region(robot, T, grasp.tilt(robot.dof))
    return f"{worst}: {explain_region_unreachable(robot, region, robot.named('home'))}"


def unreachable_reason(
    robot: RobotModel,
    position: Sequence[float],
    grasp: Grasp | None = None,
    bounds: WorkspaceBounds | None = None,
    *,
    explained: bool = True,
) -> str:
    """Return why the arm cannot grasp an object centred at (x, y, z) [m], world; empty if it can."""
    limits = bounds or WorkspaceBounds()
    outside = out_of_bounds_reason(limits, position, robot.config.base_position)
    return outside or grasp_chain_failure(robot, position, grasp or Grasp(), limits, explained=explained)


class ReachCache:
    """Caches `unreachable_reason` by position: computes inverse kinematics only once for each cell of a grid."""

    def __init__(
        self,
        robot: RobotModel,
        grasp: Grasp | None = None,
        bounds: WorkspaceBounds | None = None,
        *,
        cell: float = 0.005,
        size: int = 20_000,
        compute: Callable[[RobotModel, Sequence[float], Grasp, WorkspaceBounds], str] = grasp_chain_failure,
    ) -> None:
        """Start empty.

        Args:
            robot: must not be used by another thread while `reason` runs; `known` may be called from any.
            grasp: heights of the stages.
            bounds: of the workspace; they may change later.
            cell: positions in the same cube of this side share their answer [m].
            size: cached positions; the least recently used are dropped first.
            compute: the reason of a position within bounds.
        """
        self._robot = robot
        self._grasp = grasp or Grasp()
        self._bounds = bounds or WorkspaceBounds()
        self._cell = cell
        self._size = size
        self._compute = compute
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[int, int, int], str] = OrderedDict()
        self._resolution = _resolution(self._bounds)  # of the cached answers

    def known(self, position: Sequence[float]) -> str | None:
        """Return the reason at a position if no inverse kinematics is needed, else None."""
        reason = out_of_bounds_reason(self._bounds, position, self._robot.config.base_position)
        if reason:
            return reason
        key = self._key(position)
        with self._lock:
            if self._resolution != _resolution(self._bounds):
                self._known.clear()
                self._resolution = _resolution(self._bounds)
            if key in self._known:
                self._known.move_to_end(key)
            return self._known.get(key)

    def reason(self, position: Sequence[float]) -> str:
        """Return `unreachable_reason`; of each cell the first requested position is computed."""
        bounds = self._bounds.model_copy()  # the event loop may change them while this thread computes
        known = self.known(position)
        if known is None:
            known = self._compute(self._robot, position, self._grasp, bounds)
            with self._lock:
                if self._resolution == _resolution(bounds):
                    self._known[self._key(position)] = known
                if len(self._known) > self._size:
                    self._known.popitem(last=False)
        return known

    def _key(self, position: Sequence[float]) -> tuple[int, int, int]:
        x, y, z = (round(value / self._cell) for value in position)
        return x, y, z


def _resolution(bounds: WorkspaceBounds) -> tuple[float, ...]:
    """Return what the answer of `grasp_chain_failure` depends on, besides the position."""
    return bounds.yaw_count, bounds.line_step, bounds.max_joint_step


def yaw_candidates(count: int) -> list[float]:
    """Return yaws [rad] in (-pi/2, pi/2], the smallest turn first; a parallel gripper repeats after pi."""
    return [k * math.pi / count for k in sorted(range(-((count - 1) // 2), count // 2 + 1), key=lambda k: (abs(k), -k))]


def _chain(
    robot: RobotModel, position: Sequence[float], yaw: float, grasp: Grasp, bounds: WorkspaceBounds
) -> tuple[int, str]:
    """Return how far the chain goes with one yaw, and why it ends there; an empty reason for a complete chain.

    The arm has one joint more than the pose needs, and a planner may reach the pre-grasp in another posture than the
    one found from home. So the line must exist twice: downwards from the pre-grasp, upwards from the grasp.
    """
    x, y, z = position
    low = grasp.height(z)
    above, top = low + grasp.approach_clearance, low + grasp.lift_height
    tilt = grasp.tilt(robot.dof)
    turned = f"with any of {bounds.yaw_count} gripper orientations" if controls_full_pose(robot) else "at any yaw"
    home = robot.named("home")
    q = solve_tool_down_ik(robot, (x, y, above), yaw, home, tilt=tilt, iterations=_FROM_HOME)
    if q is None:
        return 0, f"pre-grasp at ({x:z.3f}, {y:z.3f}, {above:.3f}) has no inverse kinematics {turned}"
    for height in _line(above, low, bounds.line_step):
        q = _next(robot, (x, y, height), yaw, tilt, q, bounds) if q is not None else None
        if q is None:
            return 1, f"straight line down to ({x:z.3f}, {y:z.3f}, {low:.3f}) ends at height {height:.3f} m {turned}"
    at_grasp = solve_tool_down_ik(robot, (x, y, low), yaw, home, tilt=tilt, iterations=_FROM_HOME)
    if at_grasp is None:
        return 2, f"grasp at ({x:z.3f}, {y:z.3f}, {low:.3f}) has no inverse kinematics {turned}"
    for start in (q, at_grasp):
        q = start
        for height in _line(low, top, bounds.line_step):
            q = _next(robot, (x, y, height), yaw, tilt, q, bounds) if q is not None else None
            if q is None:
                return 3, f"lift to ({x:z.3f}, {y:z.3f}, {top:.3f}) ends at height {height:.3f} m {turned}"
    return 4, ""


def _line(start: float, end: float, step: float) -> list[float]:
    """Return heights from start (excluded) to end [m], evenly spaced, at most one step apart."""
    count = max(1, math.ceil(abs(end - start) / step - 1e-9))
    return [start + (end - start) * k / count for k in range(1, count + 1)]


def _next(
    robot: RobotModel, place: tuple[float, float, float], yaw: float, tilt: float, q: Array, bounds: WorkspaceBounds
) -> Array | None:
    """Return joint positions of the next pose of a line near the last ones, or None."""
    found = solve_tool_down_ik(robot, place, yaw, q, tilt=tilt, iterations=_FROM_NEAR, upright=False)
    if found is None or float(np.abs(found - q).max()) > bounds.max_joint_step:
        return None
    return found
