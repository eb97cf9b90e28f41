"""From a request to a trajectory: checks, planners in order, retiming, validation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from common.config import Motion, Parameters, Pipeline
from common.errors import UnknownName
from common.messages import MovingGoal, PlanAttempt, PlanningScene, PlanRequest, PlanResponse
from common.planning.collision import CollisionWorld
from common.planning.constraints import VALIDATION_SHARES, ToolConstraints
from common.planning.goal_sampling import distance_outside
from common.planning.moving_objects import scene_at, scene_for
from common.planning.obstacles import InvalidShape, ObstacleCache
from common.planning.planners import Plan, load_planner, planner_names
from common.planning.planners.joint_move import straight_profile
from common.planning.planners.sequence import SEGMENTS, NoOptions, join_segments
from common.planning.point_obstacles import PointObstacle
from common.planning.problem import (
    NOT_APPLICABLE,
    Cancel,
    GoalChoice,
    Moving,
    Problem,
    Region,
    Result,
    ToolPath,
    timing_failure,
)
from common.planning.retiming import RetimingFailed, limited_jerk
from common.planning.robot_geometry import RobotGeometry
from common.planning.trajectory import TimedPath, TooLong, cubics, join, require_sendable, stretch, trajectory_message
from common.planning.validation import (
    BadRequest,
    CheckedRequest,
    Fault,
    check_collisions,
    check_constraints,
    check_request,
    validate,
)
from common.planning.waypoint_timing import BLENDS, limit_tool_speed, retime
from common.robot.model import RobotModel
from common.time_source import monotonic

Array = NDArray[np.float64]
Planners = dict[str, tuple[Plan, Parameters]]

CHECKS = "request_checks"
TRACKING = "tracking"  # planner for moving goals, also of pipelines without it
CYCLE = 0.01  # [s] between set-points: acceleration reaches its limit no faster, whatever jerk the arm allows
FINISHING_SHARE = 0.1  # of the planning time, added to it for timing and checking a path that was found in time


class PlanningPipeline:
    """Answers plan requests one after the other. Not thread-safe."""

    def __init__(
        self, robot: RobotModel, motion: Motion, pipeline: Pipeline, *, seed: int = 0,
        validator: Callable[..., Fault | None] = validate,
    ) -> None:
        """Load the robot's collision geometry and the planners; `validator` checks every timed path.

        Raises:
            ConfigError, UnknownName: a planner, an option or a mesh that cannot be used.
        """
        self.robot = robot
        self._motion = motion
        self._pipeline = pipeline
        self._seed = seed
        self._validate = validator
        self._planners: Planners = {}
        for entry in pipeline.planners:
            self._planners[entry.name.rpartition(".")[2]] = load_planner(entry.name, entry.options)
        self._other_planners: Planners = {}  # of the project; loaded when a request names one
        self._cache = ObstacleCache(RobotGeometry(robot))

    @property
    def planners(self) -> list[str]:
        """Names of the planners in the order in which they are tried."""
        return list(self._planners)

    @property
    def geometry(self) -> RobotGeometry:
        """The robot's collision geometry."""
        return self._cache.robot

    def plan(
        self,
        request: PlanRequest,
        scene: PlanningScene,
        current: ArrayLike | None = None,
        cancel: Cancel | None = None,
        points: Sequence[PointObstacle] = (),
        width: float | None = None,
    ) -> PlanResponse:
        """Return a validated trajectory, or the error of the planner that got furthest; a bad request never raises.

        Args:
            request: start, goal and options.
            scene: obstacles and attached objects.
            current: (dof,) [rad] where the robot is, used if the request has no start.
            cancel: set from another thread to end planning early.
            points: obstacles that cameras saw and the scene does not have.
            width: of the gripper now [m], used if the request has none; None: as in the robot file.
        """
        began = monotonic()
        flag = cancel or Cancel()
        try:
            planners = self._requested_planners(request)
            state = None if current is None else np.asarray(current, dtype=float)
            checked = check_request(self.robot, request, scene, state, self._motion.start_tolerance)
            constraints = check_constraints(self.robot, request, checked)
            still = scene_for(request, scene)
            world = self._checked_world(request, still, checked, constraints, points, width)
            check_collisions(world, checked)
        except BadRequest as error:
            failure = Result(error=error.code, message=str(error), colliding=error.colliding)
            return _failure(request, began, CHECKS, failure, [])
        problem = self._problem(request, checked, world, began)
        if still is not scene:
            problem = replace(problem, moving=lambda time: self._make_world(
                request, scene_at(scene, time), checked.start, self._cache, width=width))
        return self._try_planners(request, scene, problem, planners, flag, began)

    def world(
        self, request: PlanRequest, scene: PlanningScene, start: ArrayLike, width: float | None = None
    ) -> CollisionWorld:
        """Return a collision world of a request that shares nothing with `plan`, to check a trajectory again."""
        geometry = ObstacleCache(self._cache.robot)
        still = scene_for(request, scene)
        return self._make_world(request, still, np.asarray(start, dtype=float), geometry, width=width)

    def _try_planners(
        self, request: PlanRequest, scene: PlanningScene, problem: Problem, planners: Planners, flag: Cancel,
        began: float,
    ) -> PlanResponse:
        """Return the first trajectory that passes validation, or the failure that got furthest."""
        attempts: list[PlanAttempt] = []
        best: tuple[str, Result] | None = None
        fallback: Planners = {}
        if problem.sequence is not None:
            fallback = {SEGMENTS: (partial(join_segments, planners=planners), NoOptions())}
        for name, (plan, options) in {**planners, **fallback}.items():
            if name in fallback and best is not None and best[1].error != NOT_APPLICABLE:
                break  # a planner of the pipeline handles sequences
            trajectory, result = self._try_planner(name, plan, options, problem, flag, attempts)
            if trajectory is not None:
                return PlanResponse(
                    id=request.id,
                    ok=True,
                    trajectory=trajectory_message(self.robot, trajectory),
                    planner=result.planner or name,
                    seconds=monotonic() - began,
                    scene_stamp=scene.header.stamp,
                    goal_index=_goal_index(problem, trajectory.positions[-1]),
                    meet_time=result.meet,
                    fraction=result.fraction,
                    attempts=attempts,
                )
            if best is None or best[1].error == NOT_APPLICABLE or _further(result, best[1]):
                best = (name, result)
            if result.error != NOT_APPLICABLE and flag.reason(problem):
                break
        assert best is not None  # a pipeline has at least one planner
        return _failure(request, began, best[0], best[1], attempts)

    def _try_planner(
        self, name: str, plan: Plan, options: Parameters, problem: Problem, flag: Cancel, attempts: list[PlanAttempt]
    ) -> tuple[TimedPath | None, Result]:
        """Return the planner's validated trajectory, if any, and its result; record its attempts.

        A planner whose line to one of several goals fails later is called again without that goal.
        """
        failed: dict[int, Result] = {}
        while True:
            since = monotonic()
            try:
                result = plan(replace(problem, failed_goals=failed), options, flag)
            except (RetimingFailed, TooLong) as error:  # some planners time their paths themselves
                result = timing_failure(error)
            trajectory = None
            if not result.error:
                trajectory, result = self._finish(problem, result, flag)
            if result.error != NOT_APPLICABLE:
                attempts += _recorded(name, result, monotonic() - since)
            if trajectory is not None or result.goal is None or flag.reason(problem):
                return trajectory, result
            failed[result.goal] = result

    def _requested_planners(self, request: PlanRequest) -> Planners:
        """Return the pipeline's planners, or the requested one, with default options if the pipeline lacks it."""
        name = request.planner or (TRACKING if isinstance(request.goal, MovingGoal) else "")
        if not name:
            return self._planners
        if name in self._planners:
            return {name: self._planners[name]}
        if name not in self._other_planners:
            choices = {*planner_names(), *self._planners}
            if name not in choices:
                raise BadRequest("unknown_planner", str(UnknownName("planner", name, choices)))
            self._other_planners[name] = load_planner(name, {})
        return {name: self._other_planners[name]}

    def _checked_world(
        self,
        request: PlanRequest,
        scene: PlanningScene,
        checked: CheckedRequest,
        constraints: ToolConstraints | None,
        points: Sequence[PointObstacle],
        width: float | None,
    ) -> CollisionWorld:
        try:
            return self._make_world(request, scene, checked.start, self._cache, constraints, points, width)
        except UnknownName as error:
            raise BadRequest(f"unknown_{error.what}", str(error)) from None
        except InvalidShape as error:
            raise BadRequest("bad_scene", str(error)) from None

    def _make_world(
        self,
        request: PlanRequest,
        scene: PlanningScene,
        start: Array,
        cache: ObstacleCache,
        constraints: ToolConstraints | None = None,
        points: Sequence[PointObstacle] = (),
        width: float | None = None,
    ) -> CollisionWorld:
        return CollisionWorld(
            self.robot,
            scene,
            start=start,
            padding=self._motion.object_padding,
            allowed=request.allowed_collisions,
            attach=request.attach,
            attach_pose=request.attach_pose,
            release=request.release,
            contact_distance=request.contact_distance,
            cache=cache,
            constraints=constraints,
            points=points,
            width=width if request.gripper_width is None else request.gripper_width,
        )

    def _problem(
        self, request: PlanRequest, checked: CheckedRequest, world: CollisionWorld, began: float
    ) -> Problem:
        robot, motion = self.robot, self._motion
        acceleration = request.acceleration_scaling or motion.acceleration_scaling
        budget = request.planning_time or motion.planning_time
        return Problem(
            robot=robot,
            world=world,
            start=checked.start,
            goal=checked.goal,
            straight=request.straight or isinstance(checked.goal, ToolPath),
            velocity=robot.velocity * (request.velocity_scaling or motion.velocity_scaling),
            acceleration=robot.acceleration * acceleration,
            jerk=np.minimum(robot.jerk * acceleration, robot.acceleration / CYCLE),
            attempts=request.planning_attempts or motion.planning_attempts,
            deadline=began + budget,
            latest=began + (1 + FINISHING_SHARE) * budget,
            rng=np.random.default_rng(self._seed if request.seed is None else abs(request.seed)),
            outside_start=checked.outside_start,
        )

    def _finish(self, problem: Problem, result: Result, flag: Cancel) -> tuple[TimedPath | None, Result]:
        """Return the timed and validated trajectory and the result, or None and the result with its error."""
        failure = result
        try:
            for timed in self._timings(problem, result):
                outside = problem.outside_start
                trajectory = timed if outside is None else _from_outside(problem, outside, timed)
                if flag.is_set:
                    return None, replace(result, error="cancelled", message="planning ended while a path was timed")
                require_sendable(trajectory)
                fault = self._fault(problem, trajectory)
                if fault is None:
                    return trajectory, result
                message = f"validation: {fault.message}"
                failure = replace(
                    result, error=fault.code, message=message, waypoint=fault.waypoint, colliding=fault.colliding
                )
        except (RetimingFailed, TooLong) as error:
            reason = timing_failure(error)
            failure = replace(result, error=reason.error, message=reason.message)
        return None, failure

    def _timings(self, problem: Problem, result: Result) -> Iterator[TimedPath]:
        """Yield the planner's own trajectory, or its path timed with smaller and smaller blends."""
        robot, limit = problem.robot, problem.tool_speed
        if isinstance(problem.goal, Moving):  # its times are fixed
            assert result.trajectory is not None
            yield result.trajectory
            return
        if result.trajectory is not None:
            yield limit_tool_speed(robot, limited_jerk(result.trajectory, problem.jerk), limit)
            return
        scale = self._motion.cartesian_speed_scale if result.tool_line else 1.0
        for blend in BLENDS[:1] if result.dense or result.tool_travel else BLENDS:
            trajectory = retime(problem, result, blend, limit / scale)
            trajectory = stretch(trajectory, scale) if result.tool_line else trajectory
            yield limit_tool_speed(robot, trajectory, limit)

    def _fault(self, problem: Problem, trajectory: TimedPath) -> Fault | None:
        fault = self._validate(
            trajectory,
            problem.robot,
            problem.world,
            start=problem.start if problem.outside_start is None else problem.outside_start,
            velocity=problem.velocity,
            acceleration=problem.acceleration,
            step=self._pipeline.validation_step,
        )
        constraints = problem.world.constraints
        if fault is not None or constraints is None:
            return fault
        pieces = cubics(trajectory)
        violation = constraints.first_violation(pieces, VALIDATION_SHARES)
        if violation is None:
            return None
        waypoint, t = violation
        what = constraints.describe_violation(np.array([1, t, t**2, t**3]) @ pieces[waypoint])
        return Fault("constraint", f"waypoint {waypoint} of {len(trajectory.times)}: {what}", waypoint)


def _from_outside(problem: Problem, outside: Array, trajectory: TimedPath) -> TimedPath:
    """Return the trajectory after a straight move to its start from where the robot is outside a limit."""
    inwards = straight_profile(outside, problem.start, problem.velocity, problem.acceleration, problem.jerk)
    return join([limit_tool_speed(problem.robot, inwards, problem.tool_speed), trajectory])


def _goal_index(problem: Problem, q: Array) -> int:
    """Return which of several alternative goals is reached at q (dof,) [rad]."""
    choice = problem.sequence[-1].goal if problem.sequence else problem.goal
    if not isinstance(choice, GoalChoice):
        return 0
    T_world_tcp = problem.robot.fk(q)
    distances = [
        distance_outside(goal, T_world_tcp) if isinstance(goal, Region) else float(np.abs(goal - q).max())
        for goal in choice.goals
    ]
    return int(np.argmin(distances))


def _further(one: Result, other: Result) -> bool:
    return one.error != NOT_APPLICABLE and one.fraction >= other.fraction


def _recorded(name: str, result: Result, seconds: float) -> list[PlanAttempt]:
    """Return the attempts of a planner: its own, and one for the outcome where they lack it."""
    own = result.attempts
    if own and (not result.error or own[-1].error == result.error):
        return own
    return [
        *own,
        PlanAttempt(
            planner=name,
            seconds=seconds,
            error=result.error,
            message=result.message,
            fraction=result.fraction,
            waypoint=result.waypoint,
            colliding=result.colliding,
        ),
    ]


def _failure(
    request: PlanRequest, began: float, planner: str, result: Result, attempts: list[PlanAttempt]
) -> PlanResponse:
    where = f"{request.stage}: {planner}" if request.stage else planner
    return PlanResponse(
        id=request.id,
        ok=False,
        planner=planner,
        seconds=monotonic() - began,
        fraction=result.fraction,
        error="no_planner" if result.error == NOT_APPLICABLE else result.error,
        message=f"{where}: {result.message}",
        colliding=result.colliding,
        attempts=attempts,
    )
