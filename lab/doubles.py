"""Test doubles for simulated cells: perception and planner are replaced, task and controller run as they are.

This module is also the service that replaces the motion planner: it interpolates between joint positions and ignores
obstacles.
"""

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

Array = NDArray[np.float64]

PLANNER, PERCEPTION = "motion_planner", "perception"
LEFT_OUT = ("robot_state_publisher", "viewer")  # nothing reads frames where there are no images
# Control cycles are most of the work of a run; invariants are still checked in each of them.
EXECUTOR, FEWER_CYCLES = "trajectory_executor", {"joint_state_rate": 25.0}  # [Hz]
MAX_POSES = 200  # of a path


def settings_of(application: str) -> tuple[str, ...]:
    """Return the overrides, as of `--set`, that an application's double makes before the user's."""
    double = find_application(application).double
    return double.settings if double is not None else ()


def with_doubles(cell: Cell) -> Cell:
    """Return the cell with its perception and planner replaced.

    Raises:
        ConfigError: its application has no double of its perception.
    """
    double = find_application(cell.application).double
    if double is None:
        raise ConfigError("--doubles", cell.application, "has no simulation double of its perception")
    services: dict[str, ServiceEntry] = {}
    for name, entry in cell.services.items():
        if entry.kind == PLANNER:
            services[name] = ServiceEntry(name=name, module=__name__)
        elif entry.kind in double.replaces:
            services.setdefault(PERCEPTION, ServiceEntry(name=PERCEPTION, module=double.module))
        elif entry.kind == EXECUTOR:
            services[name] = entry.model_copy(update={"parameters": FEWER_CYCLES | entry.parameters})
        elif entry.kind not in LEFT_OUT:
            services[name] = entry
    return cell.model_copy(update={"services": services})


def is_double(entry: ServiceEntry) -> bool:
    """Return whether a service replaces perception, and may read the ground truth."""
    return entry.name == PERCEPTION


class Config(Parameters):
    """Robot and speed of the planner's double."""

    robot: RobotConfig
    motion: Motion


def waypoints(robot: RobotModel, start: Array, goal: object) -> list[Array]:
    """Return joint positions [rad] of a goal; the arm stops at each.

    Raises:
        Refused: the goal is out of reach, or of an unknown type.
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
        raise Refused("not_applicable", f"the planner's double does not support {type(goal).__name__}")
    poses = [goal.pose] if isinstance(goal, m.PoseGoal) else goal.waypoints[1:MAX_POSES]
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
    """Return a trajectory within all limits that ignores obstacles."""
    start = np.array(request.start) if request.start else current
    if start is None:
        raise Refused("no_state", f"{request.stage or request.id}: no joint state received yet")
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
    """Serve plan requests as `motion_planner` does; plan from the newest joint state unless a start is given."""
    scenes, states = bus.reader(topics.PLANNING_SCENE), bus.reader(topics.JOINT_STATES)
    display = bus.writer(topics.DISPLAY_TRAJECTORY)
    robot = RobotModel.load(config.robot)
    planning = asyncio.Lock()

    async def handle(request: m.PlanRequest) -> m.PlanResponse:
        async with planning:
            if scenes.latest is None:
                raise Refused("no_scene", f"{request.stage or request.id}: no planning scene received yet")
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
