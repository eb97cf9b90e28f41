"""Planning workers: processes that plan requests that arrive while the first planner is busy; and the pool of both.

A worker is forked with all modules loaded, before its parent has started anything else. Until it is used it costs no
time and 30 MB. Threads would not help: two thirds of an easy plan are Python code.
"""

from __future__ import annotations

import asyncio
import ctypes
import mmap
import multiprocessing
import os
import pickle
import signal
import socket
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import cast

from common.config import Motion, Pipeline, RobotConfig
from common.errors import ZencellError
from common.messages import PlanningScene, PlanRequest, PlanResponse
from common.planning.pipeline import PlanningPipeline
from common.planning.point_obstacles import PointObstacle
from common.planning.problem import Cancel
from common.process.environment import lower_thread_priority, usable_cores
from common.process.lifeline import die_when_orphaned
from common.robot.model import RobotModel

OVERTIME = 30.0  # [s] beyond the planning time, in which the robot may be loaded; also after a cancellation
MOST = 3  # workers
_SIZE = 8  # bytes in front of a reply that hold its length

Setup = tuple[list[str], RobotConfig, Motion, Pipeline, int]  # sys.path and how to plan
Job = tuple[Setup | None, PlanRequest, PlanningScene | None, list[float] | None, float | None]


class WorkerDied(ZencellError):
    """The process of a worker has ended; its stderr has the reason."""


class PlanningWorker:
    """The parent's end of a worker. It takes one request at a time; all calls come from one loop."""

    def __init__(self, niceness: int = 0) -> None:
        """Fork the process with a priority lower by `niceness`; only the main thread may run yet."""
        self._socket, theirs = socket.socketpair()
        shared = mmap.mmap(-1, ctypes.sizeof(ctypes.c_int))  # with the process
        self._cancel = Cancel(ctypes.c_int.from_buffer(shared))
        self._process = multiprocessing.get_context("fork").Process(
            target=_serve, args=(theirs, self._socket, self._cancel, niceness), name="worker", daemon=True)
        self._process.start()
        theirs.close()
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._setup: Setup | None = None
        self._planning_time = 0.0  # [s] where a request names none
        self._scene: PlanningScene | None = None

    def set_up(self, robot: RobotConfig, motion: Motion, pipeline: Pipeline, *, seed: int) -> None:
        """Set how to plan; the worker loads the robot with its first request."""
        self._setup = (list(sys.path), robot, motion, pipeline, seed)
        self._planning_time = motion.planning_time

    async def plan(
        self, request: PlanRequest, scene: PlanningScene, current: list[float] | None, width: float | None = None,
    ) -> PlanResponse:
        """Return the response of a `PlanningPipeline`; a cancellation is passed to the worker and waits for its reply.

        Raises:
            WorkerDied: the process has ended, or was killed because its reply was overdue.
        """
        self._cancel.word.value = 0
        new = None if scene is self._scene else scene
        reply = asyncio.ensure_future(self._request((self._setup, request, new, current, width)))
        self._setup, self._scene = None, scene
        try:
            async with asyncio.timeout((request.planning_time or self._planning_time) + OVERTIME):
                return await asyncio.shield(reply)
        except (EOFError, OSError):  # TimeoutError is an OSError
            self.close()
            raise WorkerDied("the planning worker has ended") from None
        except asyncio.CancelledError:
            self._cancel.set()
            if reply not in (await asyncio.wait({reply}, timeout=OVERTIME))[0] or reply.exception() is not None:
                self.close()  # the next request raises WorkerDied
            raise
        finally:
            reply.cancel()

    def close(self) -> None:
        """Kill the process."""
        if self._streams is None:
            self._socket.close()
        else:
            self._streams[1].transport.abort()
        self._process.kill()
        self._process.join()

    async def _request(self, job: Job) -> PlanResponse:
        if self._streams is None:
            self._streams = await asyncio.open_connection(sock=self._socket)
        reader, writer = self._streams
        writer.write(pickle.dumps(job))
        await writer.drain()
        size = int.from_bytes(await reader.readexactly(_SIZE))
        return cast(PlanResponse, pickle.loads(await reader.readexactly(size)))


def fork_workers(niceness: int) -> list[PlanningWorker]:
    """Fork at least one worker and at most as many as leave half of the cores free; none where forking is unsafe."""
    if sys.platform != "linux":
        return []
    return [PlanningWorker(niceness) for _ in range(min(MOST, max(1, int(usable_cores()) // 2 - 1)))]


# Plans a request on a scene, from joints [rad], with a gripper width [m] and, in a thread, obstacles of cameras.
PlanCall = Callable[
    [PlanRequest, PlanningScene, list[float] | None, float | None, Callable[[], list[PointObstacle]] | None],
    Awaitable[PlanResponse],
]


class PlannerPool:
    """Planners that take one request at a time; the one added last is used first."""

    def __init__(self) -> None:
        self._free: list[PlanCall] = []
        self._available = asyncio.Semaphore(0)

    def add(self, planner: PlanCall) -> None:
        """Add a planner that is free."""
        self._free.append(planner)
        self._available.release()

    @asynccontextmanager
    async def planner(self) -> AsyncIterator[PlanCall]:
        """Yield the first free planner, in the order of the requests; a worker that died is removed from the pool."""
        await self._available.acquire()
        planner = self._free.pop()
        died = False
        try:
            yield planner
        except WorkerDied:
            died = True
            raise
        finally:
            if not died:
                self.add(planner)


async def plan_in_worker(
    worker: PlanningWorker, request: PlanRequest, scene: PlanningScene, current: list[float] | None,
    width: float | None, obstacles: Callable[[], list[PointObstacle]] | None,
) -> PlanResponse:
    """Plan in a worker, which has no obstacles of cameras."""
    assert obstacles is None
    return await worker.plan(request, scene, current, width)


async def plan_in_thread(
    pipeline: PlanningPipeline, request: PlanRequest, scene: PlanningScene, current: list[float] | None,
    width: float | None, obstacles: Callable[[], list[PointObstacle]] | None,
) -> PlanResponse:
    """Plan in a thread; a cancellation is passed to the pipeline and waits until it is free again."""
    cancel = Cancel()

    def plan() -> PlanResponse:
        lower_thread_priority()
        points = [] if obstacles is None else obstacles()
        return pipeline.plan(request, scene, current, cancel, points, width)

    planning = asyncio.create_task(asyncio.to_thread(plan))
    try:
        return await asyncio.shield(planning)
    except asyncio.CancelledError:
        cancel.set()
        await asyncio.wait({planning})
        planning.exception()  # retrieved, or asyncio would report it
        raise


def _serve(ours: socket.socket, of_parent: socket.socket, cancel: Cancel, niceness: int) -> None:
    """Plan requests in the worker's process until the parent is gone."""
    of_parent.close()
    # The socket does not report the parent's end to a stopped or planning worker, and later workers inherit a copy.
    die_when_orphaned()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent, whose end ends this process
    os.nice(niceness)
    pipeline: PlanningPipeline | None = None
    scene: PlanningScene | None = None
    with ours.makefile("rwb") as stream:
        while stream.peek(1):
            setup, request, new, current, width = cast(Job, pickle.load(stream))
            if pipeline is None:
                assert setup is not None
                sys.path[:], robot, motion, how, seed = setup
                pipeline = PlanningPipeline(RobotModel.load(robot), motion, how, seed=seed)
            scene = new or scene
            assert scene is not None
            reply = pickle.dumps(pipeline.plan(request, scene, current, cancel, (), width))
            stream.write(len(reply).to_bytes(_SIZE) + reply)
            stream.flush()
