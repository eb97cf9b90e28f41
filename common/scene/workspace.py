"""Where the arm can take things from: bounds of the workspace, the container, and the chain of poses of a grasp."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.config import Grasp, Parameters, Tunable, check
from common.planning.ik import controls_full_pose, explain_region_unreachable, pose_region, solve_tool_down_ik
from common.robot.model import RobotModel
from common.robot.transforms import tool_down

Array = npt.NDArray[np.float64]

INSIDE_CONTAINER = "inside the container"
PARTLY_OUT_OF_VIEW = "partly out of view"

# Where there is a solution it is found within 12 steps from home, and within 4 from two centimetres away.
_FROM_HOME = 16
_FROM_NEAR = 8


class WorkspaceBounds(Parameters):
    """A cylindrical shell about the robot's base axis, and the effort to find a chain of poses within it."""

    min_height: Tunable[float] = Field(-0.05, ge=-5, le=5, description="lowest z of an object [m]")
    max_height: Tunable[float] = Field(0.98, ge=-5, le=5, description="highest z of an object [m]")
    min_radius: Tunable[float] = Field(0.18, ge=0, le=5, description="least horizontal distance from the base axis [m]")
    max_radius: Tunable[float] = Field(
        0.82, gt=0, le=5, description="largest horizontal distance from the base axis [m]"
    )
    singularity_radius: Tunable[float] = Field(
        0.08, ge=0, le=5, description="column about the base axis in which the wrist axes line up [m]"
    )
    yaw_count: Tunable[int] = Field(8, ge=1, le=36, description="hand orientations tried, spread over half a turn")
    line_step: Tunable[float] = Field(0.02, gt=0, le=0.2, description="between poses checked along straight lines [m]")
    max_joint_step: Tunable[float] = Field(
        0.5, gt=0, le=3.2, description="a joint that moves further from one pose to the next has changed branch [rad]"
    )

    @model_validator(mode="after")
    def _ordered(self) -> WorkspaceBounds:
        for low, high in (("min_height", "max_height"), ("min_radius", "max_radius")):
            if getattr(self, low) >= getattr(self, high):
                raise ValueError(f"{low} {getattr(self, low):g} is not below {high} {getattr(self, high):g}")
        return self


def bounds_told(told: Mapping[str, Mapping[str, Any]]) -> WorkspaceBounds:
    """The bounds that the services of a cell are told, whichever of them judges by such.

    Args:
        told: parameters by service.

    Raises:
        ConfigError: names the parameter that does not fit.
    """
    for service, parameters in told.items():
        if given := {name: value for name, value in parameters.items() if name in WorkspaceBounds.model_fields}:
            return check(WorkspaceBounds, given, f"services.{service}")
    return WorkspaceBounds()


def outside_reason(bounds: WorkspaceBounds, position: Sequence[float]) -> str:
    """Why a place (x, y, z) [m] in world is out of bounds, with the value and the bound; empty when it is within.

    The singularity column comes first: the least radius would hide it.
    """
    x, y, z = position
    radius = math.hypot(x, y)
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


def chain_reason(
    robot: RobotModel, position: Sequence[float], grasp: Grasp, bounds: WorkspaceBounds, *, explained: bool = True
) -> str:
    """Which stage of a grasp has no solution at a place (x, y, z) [m], for any yaw; empty when one yaw has them all.

    The stages: pre-grasp above it, the straight line down, the grasp, the straight lift; tool down, from home. For an
    arm that cannot choose yaw and tilt it is looked at length for what it misses them by, unless it is not `explained`.
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


def reach_reason(
    robot: RobotModel,
    position: Sequence[float],
    grasp: Grasp | None = None,
    bounds: WorkspaceBounds | None = None,
    *,
    explained: bool = True,
) -> str:
    """Why the arm cannot take an object whose centre is at (x, y, z) [m] in world; empty when it can."""
    limits = bounds or WorkspaceBounds()
    outside = outside_reason(limits, position)
    return outside or chain_reason(robot, position, grasp or Grasp(), limits, explained=explained)


class ReachCache:
    """Answers of `reach_reason` by place: inverse kinematics only where nothing was asked before."""

    def __init__(
        self,
        robot: RobotModel,
        grasp: Grasp | None = None,
        bounds: WorkspaceBounds | None = None,
        *,
        cell: float = 0.005,
        size: int = 20_000,
    ) -> None:
        """Start empty.

        Args:
            robot: not to be used by another thread while `reason` runs; `known` may be called from any.
            grasp: heights of the stages.
            bounds: of the workspace; they may change meanwhile.
            cell: places in the same cube of this side share their answer [m].
            size: places that are remembered; the longest unused go first.
        """
        self._robot = robot
        self._grasp = grasp or Grasp()
        self._bounds = bounds or WorkspaceBounds()
        self._cell = cell
        self._size = size
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[int, int, int], str] = OrderedDict()
        self._effort = _effort(self._bounds)  # with which they were found

    def known(self, position: Sequence[float]) -> str | None:
        """The reason at a place without any inverse kinematics; None when that would be needed."""
        reason = outside_reason(self._bounds, position)
        if reason:
            return reason
        key = self._key(position)
        with self._lock:
            if self._effort != _effort(self._bounds):
                self._known.clear()
                self._effort = _effort(self._bounds)
            if key in self._known:
                self._known.move_to_end(key)
            return self._known.get(key)

    def reason(self, position: Sequence[float]) -> str:
        """As `reach_reason`; the chain is computed for the place itself, the first that is asked for in its cell."""
        bounds = self._bounds.model_copy()  # on the loop they may change while this thread computes
        known = self.known(position)
        if known is None:
            known = chain_reason(self._robot, position, self._grasp, bounds)
            with self._lock:
                if self._effort == _effort(bounds):
                    self._known[self._key(position)] = known
                if len(self._known) > self._size:
                    self._known.popitem(last=False)
        return known

    def _key(self, position: Sequence[float]) -> tuple[int, int, int]:
        x, y, z = (round(value / self._cell) for value in position)
        return x, y, z


def _effort(bounds: WorkspaceBounds) -> tuple[float, ...]:
    """What the answer of `chain_reason` depends on, besides the place."""
    return bounds.yaw_count, bounds.line_step, bounds.max_joint_step


def yaw_candidates(count: int) -> list[float]:
    """Yaws [rad] in (-pi/2, pi/2], from the smallest turn to the largest; a parallel gripper repeats after pi."""
    return [k * math.pi / count for k in sorted(range(-((count - 1) // 2), count // 2 + 1), key=lambda k: (abs(k), -k))]


def _chain(
    robot: RobotModel, position: Sequence[float], yaw: float, grasp: Grasp, bounds: WorkspaceBounds
) -> tuple[int, str]:
    """How far the chain goes with one yaw, and why it ends there; an empty reason for a whole chain.

    The arm has a joint more than the pose needs, and a planner may come to the pre-grasp in another posture than the
    one found from home. So the line must be there twice: downwards from the pre-grasp, upwards from the grasp.
    """
    x, y, z = position
    low = grasp.height(z)
    above, top = low + grasp.approach_clearance, low + grasp.lift_height
    tilt = grasp.tilt(robot.dof)
    turned = f"with any of {bounds.yaw_count} hand orientations" if controls_full_pose(robot) else "at any yaw"
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
    """Heights from start, which is left out, to end [m], evenly spaced, no further apart than step."""
    count = max(1, math.ceil(abs(end - start) / step - 1e-9))
    return [start + (end - start) * k / count for k in range(1, count + 1)]


def _next(
    robot: RobotModel, place: tuple[float, float, float], yaw: float, tilt: float, q: Array, bounds: WorkspaceBounds
) -> Array | None:
    """Joint positions of the next pose of a line, near the last ones; None when there are none."""
    found = solve_tool_down_ik(robot, place, yaw, q, tilt=tilt, iterations=_FROM_NEAR, upright=False)
    if found is None or float(np.abs(found - q).max()) > bounds.max_joint_step:
        return None
    return found
