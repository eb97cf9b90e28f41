"""Answers motion/plan: trajectories that were checked against the planning scene. Plans several requests at a time.

It also checks the running motion, and holds the arm while an object in the newest scene obstructs it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from functools import partial

from pydantic import Field

from common import topics
from common.config import Arms, Motion, Parameters, Pipeline, RobotConfig, Run, Surroundings
from common.errors import Refused
from common.messages import PlanningScene, PlanRequest, PlanResponse
from common.planning.camera_obstacles import PointsOptions
from common.planning.pipeline import PlanningPipeline
from common.process.environment import NICENESS
from common.process.obstacles import ObstacleReader, ObstructionWatchdog
from common.process.other_arms import OtherArms
from common.process.planning_worker import (
    PlannerPool,
    PlanningWorker,
    WorkerDied,
    fork_workers,
    plan_in_thread,
    plan_in_worker,
)
from common.process.service import main
from common.robot.finger_joints import measured_width
from common.robot.model import RobotModel
from common.transport.bus import Bus
from tools.check.arm import require_free_home


class Config(Parameters):
    """The sections `motion` and `pipeline` define how it plans."""

    robot: RobotConfig
    arms: Arms = Arms()
    motion: Motion
    pipeline: Pipeline
    run: Run
    world: Surroundings = Surroundings()
    watch: bool = Field(True, description="hold the arm while an object in the newest planning scene obstructs the "
                                          "running motion; enable it in one planner of a cell")
    points: PointsOptions | None = Field(None, description="cameras whose points are obstacles")
    helpers: int = Field(3, ge=0, le=3, description="limit of worker processes that plan requests while the first "
                                                    "planner is busy; at least one, and at most as many as leave half "
                                                    "of the cores free; none with points")


async def run(bus: Bus, config: Config, helpers: Sequence[PlanningWorker] = ()) -> None:
    """Serve plan requests on the newest planning scene, from the newest joint states unless a request has a start."""
    scenes = bus.reader(topics.PLANNING_SCENE)
    states = bus.reader(topics.JOINT_STATES)
    display = bus.writer(topics.DISPLAY_TRAJECTORY)
    cameras = None if config.points is None else ObstacleReader(bus, config.points)
    others = OtherArms(bus, config.arms)
    watchdog = ObstructionWatchdog(bus, scenes) if config.watch else None
    pool = PlannerPool()
    pipeline: PlanningPipeline

    async def plan(request: PlanRequest) -> tuple[PlanResponse, PlanningScene, float | None]:
        stage = request.stage or request.id
        async with pool.planner() as planner:
            scene, state = scenes.latest, states.latest
            if scene is None:
                raise Refused("no_scene", f"{stage}: no planning scene received yet")
            current = None if state is None else pipeline.robot.order(state.name, state.position)
            if not request.start and current is None:
                raise Refused("no_state", f"{stage}: no complete joint state received yet")
            obstacles = None if cameras is None else cameras.snapshot(scene, stage)
            width = None if state is None else measured_width(config.robot.gripper, state.name, state.position)
            joints = None if current is None else current.tolist()
            if standing := others.obstacles():
                around = scene.model_copy(update={"objects": [*scene.objects, *standing]})
                response = await planner(request, around, joints, width, obstacles)
                if response.trajectory is not None:
                    return response, scene, width
                bus.log.info("%s: no way around the other arm where it is: %s", stage, response.message)
            return await planner(request, scene, joints, width, obstacles), scene, width

    async def handle(request: PlanRequest) -> PlanResponse:
        try:
            response, scene, width = await plan(request)
        except WorkerDied as error:
            bus.log.error("%s: retrying %s with one worker fewer", error, request.stage or request.id)
            return await handle(request)
        response.header = bus.header()
        if response.trajectory is not None:
            response.trajectory.header = bus.header()
            if watchdog is not None:
                watchdog.monitor.add_plan(request, scene, response.trajectory, width)
            display.put(response.trajectory)
        else:
            bus.log.warning("%s [%s]", response.message, response.error)
        return response

    bus.serve(topics.MOTION_PLAN, handle)
    pipeline = await asyncio.to_thread(_load, config)
    _add_workers(pool, helpers, config)
    pool.add(partial(plan_in_thread, pipeline))
    if cameras is not None:
        await asyncio.to_thread(cameras.load, pipeline.robot, pipeline.geometry)
    await others.load()
    if watchdog is not None:
        await watchdog.load(config.robot, config.motion.object_padding)
    await bus.ready()
    try:
        async with asyncio.TaskGroup() as group:
            group.create_task(asyncio.Event().wait() if cameras is None else cameras.follow())
            if watchdog is not None:
                group.create_task(watchdog.run())
    finally:
        for worker in helpers:  # no worker outlives the service
            worker.close()


def _add_workers(pool: PlannerPool, workers: Sequence[PlanningWorker], config: Config) -> None:
    """Set up as many workers as configured, and close the others."""
    used = config.helpers if config.points is None else 0
    for worker in workers[used:]:
        worker.close()
    for worker in workers[:used]:
        worker.set_up(config.robot, config.motion, config.pipeline, seed=config.run.seed)
        pool.add(partial(plan_in_worker, worker))


def _load(config: Config) -> PlanningPipeline:
    """Return the pipeline of an arm whose home pose is free.

    Raises:
        ConfigError: the robot file does not fit its description, or the arm collides at home.
    """
    pipeline = PlanningPipeline(RobotModel.load(config.robot), config.motion, config.pipeline, seed=config.run.seed)
    require_free_home(config.robot, config.world, pipeline.geometry)
    return pipeline


if __name__ == "__main__":
    main(partial(run, helpers=fork_workers(NICENESS)), Config)
