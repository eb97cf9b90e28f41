"""From a request to a trajectory: checks, planners in order, retiming, validation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from common.config import Motion, Parameters, Pipeline
from common.errors import UnknownName
from common.messages import JointTrajectory, JointTrajectoryPoint, PlanAttempt, PlanningScene, PlanRequest, PlanResponse
from common.planning.checks import BadRequest, CheckedRequest, check_collisions, check_constraints, check_request
from common.planning.collision import CollisionWorld, Pair
from common.planning.constraints import CHECKED, ToolConstraints
from common.planning.goal_sampling import missed_by
from common.planning.legs import LEGS, NoOptions, join_legs
from common.planning.obstacles import BadShape, ObstacleCache
from common.planning.planners import Plan, load_planner, planner_names
from common.planning.planners.joint_move import straight_profile
from common.planning.points import PointObstacle
from common.planning.problem import (
    NOT_APPLICABLE,
    Cancel,
    GoalChoice,
    Problem,
    Region,
    Result,
    ToolPath,
    not_timed,
)
from common.planning.retiming import (
    RetimingFailed,
    TimedPath,
    TooLong,
    cubics,
    join,
    limited_jerk,
    require_tellable,
    stretch,
)
from common.planning.robot_geometry import RobotGeometry
from common.planning.timing import BLENDS, retime, slowed
from common.planning.validation import Fault, validate
from common.robot.model import RobotModel
from common.time_source import monotonic

Array = NDArray[np.float64]

CHECKS = "request_checks"
CYCLE = 0.01  # [s] between set-points: acceleration reaches its limit no faster, whatever the arm can do
FINISHING = 0.1  # of the time for planning, on top of it: for timing and checking a path that was found in time


class PlanningPipeline:
    """Answers plan requests, one after the other. Not for several threads at once."""

    def __init__(self, robot: RobotModel, motion: Motion, pipeline: Pipeline, *, seed: int = 0) -> None:
        """Load the robot's collision geometry and the planners.

        Raises:
            ConfigError, UnknownName: a planner, an option or a mesh that cannot be used.
        """
        self.robot = robot
        self._motion = motion
        self._pipeline = pipeline
        self._seed = seed
        self._planners: dict[str, tuple[Plan, Parameters]] = {}
        for entry in pipeline.planners:
            self._planners[entry.name.rpartition(".")[2]] = load_planner(entry.name, entry.options)
        self._others: dict[str, tuple[Plan, Parameters]] = {}  # of the project; loaded when one is asked for
        self._cache = ObstacleCache(RobotGeometry(robot))

    @property
    def planners(self) -> list[str]:
        """Names of the planners in the order in which they are tried."""
        return list(self._planners)

    def plan(
        self,
        request: PlanRequest,
        scene: PlanningScene,
        current: ArrayLike | None = None,
        cancel: Cancel | None = None,
        points: Sequence[PointObstacle] = (),
        width: float | None = None,
    ) -> PlanResponse:
        """A validated trajectory, or the error of the planner that got furthest; never raises for a bad request.

        Args:
            request: what is asked for.
            scene: what is to be avoided.
            current: (dof,) [rad] where the robot is, used when the request has no start.
            cancel: set from another thread to end planning early.
            points: what cameras saw and the scene does not have.
            width: between the fingers now [m], used when the request says none; None: as the robot file holds them.
        """
        began = monotonic()
        flag = cancel or Cancel()
        attempts: list[PlanAttempt] = []
        try:
            planners = self._chosen(request)
            state = None if current is None else np.asarray(current, dtype=float)
            checked = check_request(self.robot, request, scene, state, self._motion.start_tolerance)
            constraints = check_constraints(self.robot, request, checked)
            world = self._world(request, scene, checked, constraints, points, width)
            check_collisions(world, checked)
        except BadRequest as error:
            failure = Result(error=error.code, message=str(error), colliding=error.colliding)
            return _failed(request, began, CHECKS, failure, attempts)
        problem = self._problem(request, checked, world, began)
        best: tuple[str, Result] | None = None
        last: dict[str, tuple[Plan, Parameters]] = {}
        if problem.sequence is not None:
            last = {LEGS: (partial(join_legs, planners=planners), NoOptions())}
        for name, (plan, options) in {**planners, **last}.items():
            if name in last and best is not None and best[1].error != NOT_APPLICABLE:
                break  # there is a planner for sequences
            failed: dict[int, Result] = {}  # goals of a set to which a line was found that is not good in the end
            while True:
                since = monotonic()
                result = self._ask(plan, replace(problem, failed=failed), options, flag)
                trajectory = None
                if not result.error:
                    trajectory, result = self._finish(problem, result, flag)
                if result.error != NOT_APPLICABLE:
                    attempts += _recorded(name, result, monotonic() - since)
                if trajectory is not None or result.goal is None or flag.reason(problem):
                    break
                failed[result.goal] = result
            if trajectory is not None:
                message = trajectory_message(self.robot, trajectory)
                return PlanResponse(
                    id=request.id,
                    ok=True,
                    trajectory=message,
                    planner=result.planner or name,
                    seconds=monotonic() - began,
                    scene_stamp=scene.header.stamp,
                    goal_index=_reached(problem, trajectory.positions[-1]),
                    fraction=result.fraction,
                    attempts=attempts,
                )
            if best is None or best[1].error == NOT_APPLICABLE or _further(result, best[1]):
                best = (name, result)
            if result.error != NOT_APPLICABLE and flag.reason(problem):
                break
        assert best is not None  # a pipeline has at least one planner
        return _failed(request, began, best[0], best[1], attempts)

    @property
    def geometry(self) -> RobotGeometry:
        """The robot's collision geometry."""
        return self._cache.robot

    def world(
        self, request: PlanRequest, scene: PlanningScene, start: ArrayLike, width: float | None = None
    ) -> CollisionWorld:
        """The collision world of a request, apart from those that `plan` uses: to check a trajectory again."""
        geometry = ObstacleCache(self._cache.robot)
        return self._make_world(request, scene, np.asarray(start, dtype=float), geometry, width=width)

    def _chosen(self, request: PlanRequest) -> dict[str, tuple[Plan, Parameters]]:
        """The pipeline's planners; or the one that is asked for, with its default options if the pipeline lacks it."""
        name = request.planner
        if not name:
            return self._planners
        if name in self._planners:
            return {name: self._planners[name]}
        if name not in self._others:
            choices = {*planner_names(), *self._planners}
            if name not in choices:
                raise BadRequest("unknown_planner", str(UnknownName("planner", name, choices)))
            self._others[name] = load_planner(name, {})
        return {name: self._others[name]}

    def _world(
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
        except BadShape as error:
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
            latest=began + (1 + FINISHING) * budget,
            rng=np.random.default_rng(self._seed if request.seed is None else abs(request.seed)),
            beyond=checked.beyond,
        )

    def _ask(self, plan: Plan, problem: Problem, options: Parameters, flag: Cancel) -> Result:
        """The planner's answer; some time their paths themselves, and may fail at that."""
        try:
            return plan(problem, options, flag)
        except (RetimingFailed, TooLong) as error:
            return not_timed(error)

    def _finish(self, problem: Problem, result: Result, flag: Cancel) -> tuple[TimedPath | None, Result]:
        """The timed and validated trajectory and the result, or None and the result with what is wrong."""
        wrong = result
        try:
            for timed in self._timings(problem, result):
                trajectory = timed if problem.beyond is None else _from_beyond(problem, problem.beyond, timed)
                if flag.is_set:
                    return None, replace(result, error="cancelled", message="planning was ended while a path was timed")
                require_tellable(trajectory)
                fault = self._fault(problem, trajectory)
                if fault is None:
                    return trajectory, result
                message = f"validation: {fault.message}"
                wrong = replace(
                    result, error=fault.code, message=message, waypoint=fault.waypoint, colliding=fault.colliding
                )
        except RetimingFailed as error:
            wrong = replace(result, error="retiming_failed", message=f"retiming: {error}")
        except TooLong as error:
            wrong = replace(result, error=error.code, message=str(error))
        return None, wrong

    def _timings(self, problem: Problem, result: Result) -> Iterator[TimedPath]:
        """The planner's own trajectory, or its path timed with smaller and smaller blends."""
        robot, limit = problem.robot, problem.tool_speed
        if result.trajectory is not None:
            yield slowed(robot, limited_jerk(result.trajectory, problem.jerk), limit)
            return
        scale = self._motion.cartesian_speed_scale if result.tool_line else 1.0
        for blend in BLENDS[:1] if result.dense or result.way else BLENDS:
            trajectory = retime(problem, result, blend, limit / scale)
            trajectory = stretch(trajectory, scale) if result.tool_line else trajectory
            yield slowed(robot, trajectory, limit)

    def _fault(self, problem: Problem, trajectory: TimedPath) -> Fault | None:
        fault = validate(
            trajectory,
            problem.robot,
            problem.world,
            start=problem.start if problem.beyond is None else problem.beyond,
            velocity=problem.velocity,
            acceleration=problem.acceleration,
            step=self._pipeline.validation_step,
        )
        constraints = problem.world.constraints
        if fault is not None or constraints is None:
            return fault
        pieces = cubics(trajectory)
        broken = constraints.first_break(pieces, CHECKED)
        if broken is None:
            return None
        waypoint, t = broken
        wrong = constraints.told_at(np.array([1, t, t**2, t**3]) @ pieces[waypoint])
        return Fault("constraint", f"waypoint {waypoint} of {len(trajectory.times)}: {wrong}", waypoint)


def _from_beyond(problem: Problem, beyond: Array, trajectory: TimedPath) -> TimedPath:
    """The trajectory, after a straight move to its start from where the robot stands beyond a limit."""
    inwards = straight_profile(beyond, problem.start, problem.velocity, problem.acceleration, problem.jerk)
    return join([slowed(problem.robot, inwards, problem.tool_speed), trajectory])


def _reached(problem: Problem, q: Array) -> int:
    """Which of several goals to choose from q (dof,) [rad] is at."""
    choice = problem.sequence[-1].goal if problem.sequence else problem.goal
    if not isinstance(choice, GoalChoice):
        return 0
    T_world_tcp = problem.robot.fk(q)
    missed = [
        missed_by(goal, T_world_tcp) if isinstance(goal, Region) else float(np.abs(goal - q).max())
        for goal in choice.goals
    ]
    return int(np.argmin(missed))


def _further(one: Result, other: Result) -> bool:
    return one.error != NOT_APPLICABLE and one.fraction >= other.fraction


def _recorded(name: str, result: Result, seconds: float) -> list[PlanAttempt]:
    """The attempts of a planner; its own, and one for the outcome where they do not tell it."""
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


def _failed(
    request: PlanRequest, began: float, planner: str, result: Result, attempts: list[PlanAttempt]
) -> PlanResponse:
    error = "no_planner" if result.error == NOT_APPLICABLE else result.error
    where = f"{request.stage}: {planner}" if request.stage else planner
    pair: Pair | None = result.colliding
    return PlanResponse(
        id=request.id,
        ok=False,
        planner=planner,
        seconds=monotonic() - began,
        fraction=result.fraction,
        error=error,
        message=f"{where}: {result.message}",
        colliding=pair,
        attempts=attempts,
    )


def trajectory_message(robot: RobotModel, trajectory: TimedPath) -> JointTrajectory:
    """The message of a trajectory that was found good."""
    # Validation has just found these numbers finite and in shape: checking each again would take milliseconds.
    columns = (
        trajectory.times.tolist(),
        trajectory.positions.tolist(),
        trajectory.velocities.tolist(),
        trajectory.accelerations.tolist(),
    )
    points = [
        JointTrajectoryPoint.model_construct(time_from_start=t, positions=q, velocities=dq, accelerations=ddq)
        for t, q, dq, ddq in zip(*columns, strict=True)
    ]
    return JointTrajectory.model_construct(joint_names=list(robot.joint_names), points=points)
