"""A cell with doubles in the place of its perception and its planner: what decides and moves is as it is."""

from __future__ import annotations

import asyncio

import numpy as np
from numpy.typing import NDArray

from common import messages as m
from common import topics
from common.application import find_application
from common.config import Cell, Motion, Parameters, RobotConfig, ServiceEntry
from common.errors import ConfigError, Refused
from common.planning.ik import controls_full_pose, solve_ik, solve_region_ik
from common.planning.planners.joint_move import straight_profile
from common.planning.problem import Region
from common.planning.trajectory import TimedPath, join, trajectory_message
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from common.transport.bus import Bus

PLANNER, PERCEPTION = "motion_planner", "perception"
PLANNER_DOUBLE = "lab.doubles"
LEFT_OUT = ("robot_state_publisher", "viewer")  # nobody looks at frames where there are no pictures
# Control cycles are most of the work of a run; what holds in each of them is looked at all the same.
EXECUTOR, FEWER_CYCLES = "trajectory_executor", {"joint_state_rate": 25.0}  # [Hz]


def settings_of(application: str) -> tuple[str, ...]:
    """What its application sets in a cell with doubles, as of `--set`, before all that a person sets."""
    double = find_application(application).double
    return double.settings if double is not None else ()


def with_doubles(cell: Cell) -> Cell:
    """The cell with doubles.

    Raises:
        ConfigError: its application brings no double of its perception.
    """
    double = find_application(cell.application).double
    if double is None:
        raise ConfigError("--doubles", cell.application, "has no simulation double of its perception")
    services: dict[str, ServiceEntry] = {}
    for name, entry in cell.services.items():
        if entry.kind == PLANNER:
            services[name] = ServiceEntry(name=name, module=PLANNER_DOUBLE)
        elif entry.kind in double.replaces:
            services.setdefault(PERCEPTION, ServiceEntry(name=PERCEPTION, module=double.module))
        elif entry.kind == EXECUTOR:
            services[name] = entry.model_copy(update={"parameters": FEWER_CYCLES | entry.parameters})
        elif entry.kind not in LEFT_OUT:
            services[name] = entry
    return cell.model_copy(update={"services": services})


def is_double(entry: ServiceEntry) -> bool:
    """Whether a service stands for others, and may see the truth."""
    return entry.name == PERCEPTION


Array = NDArray[np.float64]

MOST_POSES = 200  # of a path


class Config(Parameters):
    """How fast it is."""

    robot: RobotConfig
    motion: Motion


def waypoints(robot: RobotModel, start: Array, goal: object) -> list[Array]:
    """Joint positions [rad] to come to rest at, one after the other.

    Raises:
        Refused: the goal is out of reach, or none of joints, pose and path.
    """
    if isinstance(goal, m.JointGoal):
        return [robot.named(goal.named) if goal.named else np.array(goal.positions)]
    if isinstance(goal, m.GoalSet):
        return waypoints(robot, start, goal.goals[0])
    if isinstance(goal, m.SequenceGoal):
        passed = [start]
        for item in goal.items:
            passed += waypoints(robot, passed[-1], item.goal)
        return passed[1:]
    if not isinstance(goal, m.PoseGoal | m.PathGoal):
        raise Refused("not_applicable", f"the planner's double knows no {type(goal).__name__}")
    poses = [goal.pose] if isinstance(goal, m.PoseGoal) else goal.waypoints[1:MOST_POSES]
    found = [start]
    for pose in poses:
        T = pose_to_matrix(pose)
        if controls_full_pose(robot) or not isinstance(goal, m.PoseGoal):
            q = solve_ik(robot, T, found[-1])
        else:
            region = Region(T, np.zeros(3), goal.tilt_tolerance, goal.yaw_tolerance)
            q = solve_region_ik(robot, region, found[-1], restarts=20)
        if q is None:
            raise Refused("no_ik", f"({pose.position.x:.3f}, {pose.position.y:.3f}, {pose.position.z:.3f}) is out of "
                                   "reach")
        found.append(q)
    return found[1:]


def plan(robot: RobotModel, motion: Motion, request: m.PlanRequest, current: Array | None) -> m.PlanResponse:
    """A trajectory that any controller can follow."""
    start = np.array(request.start) if request.start else current
    if start is None:
        raise Refused("no_state", f"{request.stage or request.id}: the joint states are not known yet")
    velocity = robot.velocity * (request.velocity_scaling or motion.velocity_scaling)
    scaling = request.acceleration_scaling or motion.acceleration_scaling
    parts: list[TimedPath] = []
    try:
        for q in waypoints(robot, start, request.goal):
            parts.append(straight_profile(start, q, velocity, robot.acceleration * scaling, robot.jerk * scaling))
            start = q
    except Refused as error:
        return m.PlanResponse(id=request.id, ok=False, error=error.code, message=str(error))
    return m.PlanResponse(id=request.id, ok=True, trajectory=trajectory_message(robot, join(parts)), fraction=1.0)


async def run(bus: Bus, config: Config) -> None:
    """Serve plan requests as `motion_planner` does, from the newest joint states unless a start is given."""
    scenes, states = bus.reader(topics.PLANNING_SCENE), bus.reader(topics.JOINT_STATES)
    display = bus.writer(topics.DISPLAY_TRAJECTORY)
    robot = RobotModel.load(config.robot)
    one_at_a_time = asyncio.Lock()

    async def handle(request: m.PlanRequest) -> m.PlanResponse:
        async with one_at_a_time:
            if scenes.latest is None:
                raise Refused("no_scene", f"{request.stage or request.id}: there is no planning scene yet")
            state = states.latest
            current = None if state is None else robot.order(state.name, state.position)
            response = await asyncio.to_thread(plan, robot, config.motion, request, current)
        response.header = bus.header()
        if response.trajectory is not None:
            response.trajectory.header = bus.header()
            display.put(response.trajectory)
        else:
            bus.log.warning("%s [%s]", response.message, response.error)
        return response

    bus.serve(topics.MOTION_PLAN, handle)
    await bus.ready()
    await asyncio.Event().wait()
