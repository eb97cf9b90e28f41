"""Answers motion/plan: trajectories that were checked against the planning scene. Plans one request at a time."""

from __future__ import annotations

import asyncio

from common import topics
from common.config import Motion, Parameters, Pipeline, RobotConfig, Run
from common.errors import Refused
from common.messages import PlanningScene, PlanRequest, PlanResponse
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Cancel
from common.process.service import main
from common.robot.model import RobotModel
from common.transport.bus import Bus


class Config(Parameters):
    """The motion planner has no parameters of its own: see motion and pipeline."""

    robot: RobotConfig
    motion: Motion
    pipeline: Pipeline
    run: Run


async def run(bus: Bus, config: Config) -> None:
    """Serve plan requests on the newest planning scene, from the newest joint states unless a start is given."""
    scenes = bus.reader(topics.PLANNING_SCENE)
    states = bus.reader(topics.JOINT_STATES)
    display = bus.writer(topics.DISPLAY_TRAJECTORY)
    one_at_a_time = asyncio.Lock()
    loaded: list[PlanningPipeline] = []

    async def handle(request: PlanRequest) -> PlanResponse:
        async with one_at_a_time:
            scene, pipeline = scenes.latest, loaded[0]
            if scene is None:
                raise Refused("no_scene", f"{request.stage or request.id}: there is no planning scene yet")
            state = states.latest
            current = None if state is None else pipeline.robot.order(state.name, state.position)
            if not request.start and current is None:
                raise Refused("no_state", f"{request.stage or request.id}: the joint states are not known yet")
            response = await _plan(pipeline, request, scene, None if current is None else current.tolist())
        response.header = bus.header()
        if response.trajectory is not None:
            response.trajectory.header = bus.header()
            display.put(response.trajectory)
        else:
            bus.log.warning("%s [%s]", response.message, response.error)
        return response

    bus.serve(topics.MOTION_PLAN, handle)
    loaded.append(await asyncio.to_thread(_load, config))
    await bus.ready()
    await asyncio.Event().wait()


def _load(config: Config) -> PlanningPipeline:
    return PlanningPipeline(RobotModel.load(config.robot), config.motion, config.pipeline, seed=config.run.seed)


async def _plan(
    pipeline: PlanningPipeline, request: PlanRequest, scene: PlanningScene, current: list[float] | None
) -> PlanResponse:
    """Plan in a thread; when this is cancelled the planner is told and waited for: never two at once."""
    cancel = Cancel()
    planning = asyncio.create_task(asyncio.to_thread(pipeline.plan, request, scene, current, cancel))
    try:
        return await asyncio.shield(planning)
    except asyncio.CancelledError:
        cancel.set()
        await asyncio.wait({planning})
        raise


if __name__ == "__main__":
    main(run, Config)
