"""A second planner in a process of its own, for requests that come while the first one is at work.

It is forked with all modules loaded, before its parent has begun anything: until it is needed it takes no time, and
30 MB. Threads would not do: two thirds of an easy plan are Python's.
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
from typing import cast

from common.config import Motion, Pipeline, RobotConfig
from common.errors import ZencellError
from common.messages import PlanningScene, PlanRequest, PlanResponse
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Cancel
from common.process.environment import usable_cores
from common.process.lifeline import die_when_orphaned
from common.robot.model import RobotModel

PATIENCE = 30.0  # [s] beyond the time for planning, in which the robot may be loaded; also after giving up was told
MOST = 3
_SIZE = 8  # bytes ahead of an answer, which say how long it is

Setup = tuple[list[str], RobotConfig, Motion, Pipeline, int]  # where modules are found, and how to plan
Job = tuple[Setup | None, PlanRequest, PlanningScene | None, list[float] | None, float | None]


class HelperLost(ZencellError):
    """The process has ended; what it said of that is on stderr."""


class Helper:
    """This end of the way to the process. One plan at a time, all on one loop."""

    def __init__(self, niceness: int = 0) -> None:
        """Fork the process, by so much nicer than this one, in which nothing may run yet but the main thread."""
        self._socket, theirs = socket.socketpair()
        shared = mmap.mmap(-1, ctypes.sizeof(ctypes.c_int))  # with the process
        self._cancel = Cancel(ctypes.c_int.from_buffer(shared))
        self._process = multiprocessing.get_context("fork").Process(
            target=_be, args=(theirs, self._socket, self._cancel, niceness), name="helper", daemon=True)
        self._process.start()
        theirs.close()
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._setup: Setup | None = None
        self._usual = 0.0  # [s] for planning where a request does not say
        self._scene: PlanningScene | None = None

    def set_up(self, robot: RobotConfig, motion: Motion, pipeline: Pipeline, *, seed: int) -> None:
        """Say how to plan; the robot is loaded when the first request comes."""
        self._setup = (list(sys.path), robot, motion, pipeline, seed)
        self._usual = motion.planning_time

    async def plan(
        self, request: PlanRequest, scene: PlanningScene, current: list[float] | None, width: float | None = None,
    ) -> PlanResponse:
        """The answer of a `PlanningPipeline` to the same; when this is cancelled the process is told, and waited for.

        Raises:
            HelperLost: the process has ended, or was ended because it did not answer for much too long.
        """
        self._cancel.word.value = 0
        new = None if scene is self._scene else scene
        asked = asyncio.ensure_future(self._ask((self._setup, request, new, current, width)))
        self._setup, self._scene = None, scene
        try:
            async with asyncio.timeout((request.planning_time or self._usual) + PATIENCE):
                return await asyncio.shield(asked)
        except (EOFError, OSError):  # a TimeoutError is one, too
            self.close()
            raise HelperLost("the second planner has ended") from None
        except asyncio.CancelledError:
            self._cancel.set()
            if asked not in (await asyncio.wait({asked}, timeout=PATIENCE))[0] or asked.exception() is not None:
                self.close()  # who plans with it next is told
            raise
        finally:
            asked.cancel()

    def close(self) -> None:
        """End the process, whatever it does."""
        if self._streams is None:
            self._socket.close()
        else:
            self._streams[1].transport.abort()
        self._process.kill()
        self._process.join()

    async def _ask(self, job: Job) -> PlanResponse:
        if self._streams is None:
            self._streams = await asyncio.open_connection(sock=self._socket)
        reader, writer = self._streams
        writer.write(pickle.dumps(job))
        await writer.drain()
        size = int.from_bytes(await reader.readexactly(_SIZE))
        return cast(PlanResponse, pickle.loads(await reader.readexactly(size)))


def fork_helpers(niceness: int) -> list[Helper]:
    """As many as leave half of the cores to others, at least one; none where forking is not safe."""
    if sys.platform != "linux":
        return []
    return [Helper(niceness) for _ in range(min(MOST, max(1, int(usable_cores()) // 2 - 1)))]


def _be(ours: socket.socket, of_parent: socket.socket, cancel: Cancel, niceness: int) -> None:
    """Be the process, until the parent is gone."""
    of_parent.close()
    die_when_orphaned()  # the other end tells nothing to who is stopped or plans, and who was forked later has it
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # meant for the parent, whose end ends us
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
            answer = pickle.dumps(pipeline.plan(request, scene, current, cancel, (), width))
            stream.write(len(answer).to_bytes(_SIZE) + answer)
            stream.flush()
