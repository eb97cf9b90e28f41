"""Answers motion/plan: trajectories that were checked against the planning scene. Plans several requests at a time.

It also watches the motion that runs, and holds the arm while the newest scene has something in its way.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from typing import Any, Literal

from pydantic import Field

from common import topics
from common.config import Motion, Parameters, Pipeline, RobotConfig, Run, Surroundings
from common.errors import Refused, RemoteError, RequestFailed
from common.messages import (
    CameraInfo,
    FollowedRequest,
    HoldRequest,
    Image,
    MotionStatus,
    PlanningScene,
    PlanRequest,
    PlanResponse,
    PointCloud2,
)
from common.planning.camera_obstacles import Camera, CameraMessages, CameraObstacles, JointHistory, PointsOptions
from common.planning.pipeline import PlanningPipeline
from common.planning.point_obstacles import PointObstacle
from common.planning.problem import Cancel
from common.planning.scene_monitor import NotMonitored, SceneMonitor
from common.process.environment import NICENESS, lower_thread_priority
from common.process.planning_worker import PlanningWorker, WorkerDied, fork_workers
from common.process.service import main
from common.robot.finger_joints import measured_width
from common.robot.model import RobotModel
from common.transport.bus import Bus
from common.transport.reader import Reader
from tools.check.arm import require_free_home

HOLDER: Literal["scene_monitor"] = "scene_monitor"
REQUEST_TIMEOUT = 0.2  # [s] wall; it is asked again after that
AGAIN_AFTER = 0.05  # [s] wall


class Config(Parameters):
    """How it plans is said by motion and pipeline."""

    robot: RobotConfig
    motion: Motion
    pipeline: Pipeline
    run: Run
    world: Surroundings = Surroundings()
    watch: bool = Field(True, description="hold the arm while something in the newest planning scene is in the way of "
                                          "the motion that runs; one planner of a cell does so")
    points: PointsOptions | None = Field(None, description="cameras whose points are obstacles")
    helpers: int = Field(3, ge=0, le=3, description="other processes at most that plan what comes while this one is "
                                                    "at work; not more than leave half of the cores to others, at "
                                                    "least one; none with points")


Planner = Callable[..., Awaitable[PlanResponse]]  # of request, scene, joints, width and what makes obstacles of points


async def run(bus: Bus, config: Config, helpers: Sequence[PlanningWorker] = ()) -> None:
    """Serve plan requests on the newest planning scene, from the newest joint states unless a start is given."""
    scenes = bus.reader(topics.PLANNING_SCENE)
    states = bus.reader(topics.JOINT_STATES)
    display = bus.writer(topics.DISPLAY_TRAJECTORY)
    eyes = None if config.points is None else Eyes(bus, config.points)
    watcher = Watcher(bus, scenes) if config.watch else None
    crew = Crew()
    loaded: list[PlanningPipeline] = []

    async def plan(request: PlanRequest) -> tuple[PlanResponse, PlanningScene, float | None]:
        async with crew.one() as planner:
            scene, pipeline = scenes.latest, loaded[0]
            if scene is None:
                raise Refused("no_scene", f"{request.stage or request.id}: there is no planning scene yet")
            state = states.latest
            current = None if state is None else pipeline.robot.order(state.name, state.position)
            if not request.start and current is None:
                raise Refused("no_state", f"{request.stage or request.id}: the joint states are not known yet")
            see = None if eyes is None else eyes.look(scene, request.stage or request.id)
            width = None if state is None else measured_width(config.robot.gripper, state.name, state.position)
            joints = None if current is None else current.tolist()
            return await planner(request, scene, joints, width, see), scene, width

    async def handle(request: PlanRequest) -> PlanResponse:
        try:
            response, scene, width = await plan(request)
        except WorkerDied as lost:
            bus.log.error("%s: %s is planned again, by one fewer from now on", lost, request.stage or request.id)
            return await handle(request)
        response.header = bus.header()
        if response.trajectory is not None:
            response.trajectory.header = bus.header()
            if watcher is not None:
                watcher.monitor.add_plan(request, scene, response.trajectory, width)
            display.put(response.trajectory)
        else:
            bus.log.warning("%s [%s]", response.message, response.error)
        return response

    bus.serve(topics.MOTION_PLAN, handle)
    loaded.append(await asyncio.to_thread(_load, config))
    for helper in helpers[config.helpers if config.points is None else 0:]:
        helper.close()
    for helper in helpers[:config.helpers if config.points is None else 0]:
        helper.set_up(config.robot, config.motion, config.pipeline, seed=config.run.seed)
        crew.join(partial(_by_helper, helper))
    crew.join(partial(_plan, loaded[0]))
    if eyes is not None:
        await asyncio.to_thread(eyes.load, loaded[0])
    if watcher is not None:
        watcher.loaded.append(await asyncio.to_thread(SceneMonitor, config.robot, config.motion.object_padding))
    await bus.ready()
    try:
        async with asyncio.TaskGroup() as group:
            group.create_task(asyncio.Event().wait() if eyes is None else eyes.follow())
            if watcher is not None:
                group.create_task(watcher.run())
    finally:
        for helper in helpers:  # who waits for our end finds none of them
            helper.close()


def _load(config: Config) -> PlanningPipeline:
    """The pipeline, of an arm that may be at home.

    Raises:
        ConfigError: the robot file does not fit its description, or the arm touches something at home.
    """
    pipeline = PlanningPipeline(RobotModel.load(config.robot), config.motion, config.pipeline, seed=config.run.seed)
    require_free_home(config.robot, config.world, pipeline.geometry)
    return pipeline


async def _by_helper(
    helper: PlanningWorker, request: PlanRequest, scene: PlanningScene, current: list[float] | None,
    width: float | None, see: Callable[[], list[PointObstacle]] | None,
) -> PlanResponse:
    assert see is None
    return await helper.plan(request, scene, current, width)


class Crew:
    """Those who plan, each one request at a time; who joined last is asked first."""

    def __init__(self) -> None:
        self._free: list[Planner] = []
        self._some_free = asyncio.Semaphore(0)

    def join(self, planner: Planner) -> None:
        """Be asked from now on."""
        self._free.append(planner)
        self._some_free.release()

    @asynccontextmanager
    async def one(self) -> AsyncIterator[Planner]:
        """Whoever is free first; requests have their turns in the order in which they came. Who is lost is out."""
        await self._some_free.acquire()
        planner = self._free.pop()
        stays = True
        try:
            yield planner
        except WorkerDied:
            stays = False
            raise
        finally:
            if stays:
                self.join(planner)


class Watcher:
    """Judges the motion that runs on every scene message, and has the arm held while something is in its way.

    It computes on the loop, for a millisecond where something has moved: planning goes on in threads.
    """

    def __init__(self, bus: Bus, scenes: Reader[PlanningScene]) -> None:
        self._bus, self._scenes, self._motion = bus, scenes, bus.reader(topics.MOTION_STATUS)
        self._hold, self._followed = bus.client(topics.MOTION_HOLD), bus.client(topics.MOTION_FOLLOWED)
        self._woken = asyncio.Event()
        self._answer: MotionStatus | None = None  # to the newest hold
        self.loaded: list[SceneMonitor] = []

    @property
    def monitor(self) -> SceneMonitor:
        """What judges."""
        return self.loaded[0]

    async def run(self) -> None:
        """Watch until cancelled."""
        async with asyncio.TaskGroup() as group:
            for reader in (self._scenes, self._motion):
                group.create_task(self._wake_on(reader))
            while True:
                await self._woken.wait()
                self._woken.clear()
                try:
                    await self._look()
                except NotMonitored as error:
                    self._bus.log.warning("the motion that runs is not watched: %s", error)
                except RequestFailed as error:
                    self._bus.log.warning("%s", error)
                    group.create_task(self._look_again())

    async def _wake_on(self, reader: Reader[Any]) -> None:
        async for _ in reader:
            self._woken.set()

    async def _look_again(self) -> None:
        await asyncio.sleep(AGAIN_AFTER)
        self._woken.set()

    async def _look(self) -> None:
        status, scene = self._motion.latest, self._scenes.latest
        if status is not None and self._answer is not None and self._answer.header.stamp > status.header.stamp:
            status = self._answer
        if status is None or scene is None or status.state != "active" or not status.id:
            self.monitor.unfollow()
            return
        if status.id != self.monitor.goal:
            await self._follow(status)
        problem, held = self.monitor.find_obstruction(scene, status.progress), HOLDER in status.held_by
        if bool(problem) == held:
            return
        request = HoldRequest(hold=bool(problem), reason=problem, by=HOLDER, goal=status.id)
        self._answer = await self._hold.call(request, REQUEST_TIMEOUT)
        if problem and HOLDER not in self._answer.held_by:
            self._woken.set()  # it was over by then: look at what runs now
        elif problem:
            self._bus.log.warning("the arm is held: %s", problem)
        else:
            self._bus.log.info("the arm goes on: nothing is in its way any more")

    async def _follow(self, status: MotionStatus) -> None:
        if self.monitor.has_plan(status.plan):
            self.monitor.follow(status.id, status.plan)
            return
        try:
            asked = await self._followed.call(FollowedRequest(id=status.id), REQUEST_TIMEOUT)
        except RemoteError as error:  # it is over by now
            self.monitor.unfollow(status.id)
            raise NotMonitored(str(error)) from None
        self.monitor.follow(status.id, asked.plan, asked.trajectory)


class Eyes:
    """The newest of what each camera sent, and where the robot was."""

    def __init__(self, bus: Bus, options: PointsOptions) -> None:
        self._bus, self._options = bus, options
        self._readers = [_readers(bus, camera) for camera in options.cameras]
        self._poses, self._states = bus.reader(topics.TF_STATIC), bus.reader(topics.JOINT_STATES)
        self._loaded: list[tuple[CameraObstacles, JointHistory]] = []

    def load(self, pipeline: PlanningPipeline) -> None:
        """Take over the robot."""
        seeing = CameraObstacles(pipeline.robot, pipeline.geometry, self._options)
        self._loaded.append((seeing, JointHistory(pipeline.robot)))

    async def follow(self) -> None:
        """Note where the robot is, for as long as the service runs."""
        async for state in self._states:
            self._loaded[0][1].add(state)

    def look(self, scene: PlanningScene, stage: str) -> Callable[[], list[PointObstacle]]:
        """What makes obstacles, in a thread, of what has come until now."""
        (seeing, joints), now, poses = self._loaded[0], self._bus.clock.now_ns(), self._poses.latest
        seen = [
            CameraMessages(camera, pictures.latest, None if infos is None else infos.latest)
            for camera, (pictures, infos) in zip(self._options.cameras, self._readers, strict=True)
        ]

        def obstacles() -> list[PointObstacle]:
            try:
                return seeing.obstacles(seen, poses, joints, scene, now)
            except Refused as error:
                raise Refused(error.code, f"{stage}: {error}") from None

        return obstacles


def _readers(
    bus: Bus, camera: Camera
) -> tuple[Reader[PointCloud2] | Reader[Image], Reader[CameraInfo] | None]:
    if camera.points:
        return bus.reader(replace(topics.DEPTH_CAMERA_POINTS, key=camera.points)), None
    depths = bus.reader(replace(topics.DEPTH_CAMERA_DEPTH, key=camera.depth))
    return depths, bus.reader(replace(topics.DEPTH_CAMERA_INFO, key=camera.info))


async def _plan(
    pipeline: PlanningPipeline,
    request: PlanRequest,
    scene: PlanningScene,
    current: list[float] | None,
    width: float | None,
    see: Callable[[], list[PointObstacle]] | None,
) -> PlanResponse:
    """Plan in a thread; when this is cancelled the planner is told and waited for: it is free only then."""
    cancel = Cancel()

    def plan() -> PlanResponse:
        lower_thread_priority()
        points = [] if see is None else see()
        return pipeline.plan(request, scene, current, cancel, points, width)

    planning = asyncio.create_task(asyncio.to_thread(plan))
    try:
        return await asyncio.shield(planning)
    except asyncio.CancelledError:
        cancel.set()
        await asyncio.wait({planning})
        planning.exception()  # which is no news then
        raise


if __name__ == "__main__":
    main(partial(run, helpers=fork_workers(NICENESS)), Config)
