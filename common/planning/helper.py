"""A second planner in a process of its own, for requests that come while the first one is at work.

It is forked with all modules loaded, before its parent has begun anything: until it is needed it takes no time, and a
few megabytes. Threads would not do: two thirds of an easy plan are Python's.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import sys
import threading
from multiprocessing.connection import Connection

from common.config import Motion, Pipeline, RobotConfig
from common.errors import ZencellError
from common.messages import PlanningScene, PlanRequest, PlanResponse
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Cancel
from common.robot.model import RobotModel

LOOK = 0.005  # [s] between looks at whether somebody gave up
MOST = 3

Setup = tuple[RobotConfig, Motion, Pipeline, int]
Job = tuple[int, Setup | None, PlanRequest, PlanningScene | None, list[float] | None, float | None]


class HelperLost(ZencellError):
    """The process has ended; what it said of that is on stderr."""


class Helper:
    """This end of the pipe to the process. One plan at a time."""

    def __init__(self, niceness: int = 0) -> None:
        """Fork the process, by so much nicer than this one, in which nothing may run yet but the main thread."""
        self._pipe, theirs = multiprocessing.Pipe()
        process = multiprocessing.get_context("fork").Process(
            target=_be, args=(theirs, self._pipe, niceness), name="helper", daemon=True)
        process.start()
        theirs.close()
        self._setup: Setup | None = None
        self._scene: PlanningScene | None = None
        self._asked = 0

    def set_up(self, robot: RobotConfig, motion: Motion, pipeline: Pipeline, *, seed: int) -> None:
        """Say how to plan; the robot is loaded when the first request comes."""
        self._setup = (robot, motion, pipeline, seed)

    def plan(
        self, request: PlanRequest, scene: PlanningScene, current: list[float] | None, cancel: Cancel,
        width: float | None = None,
    ) -> PlanResponse:
        """The answer of a `PlanningPipeline` to the same; waits for it.

        Raises:
            HelperLost: the process has ended.
        """
        self._asked += 1
        new, told = None if scene is self._scene else scene, False
        try:
            self._pipe.send((self._asked, self._setup, request, new, current, width))
            self._setup, self._scene = None, scene
            while not self._pipe.poll(LOOK):
                if cancel.is_set and not told:
                    told = True
                    self._pipe.send(self._asked)
            response: PlanResponse = self._pipe.recv()
        except (EOFError, OSError):
            raise HelperLost("the second planner has ended") from None
        return response

    def close(self) -> None:
        """Have the process end."""
        self._pipe.close()


def fork_helpers(niceness: int) -> list[Helper]:
    """As many as leave half of the cores to others, at least one; none where forking is not safe."""
    if sys.platform != "linux":
        return []
    return [Helper(niceness) for _ in range(min(MOST, max(1, (os.cpu_count() or 1) // 2 - 1)))]


def _be(pipe: Connection, of_parent: Connection, niceness: int) -> None:
    """Be the process, until the other end of the pipe is gone."""
    of_parent.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # meant for the parent, whose end ends us
    os.nice(niceness)
    jobs: queue.SimpleQueue[tuple[Job, Cancel]] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(pipe, jobs), daemon=True).start()
    pipeline: PlanningPipeline | None = None
    scene: PlanningScene | None = None
    while True:
        (_, setup, request, new, current, width), cancel = jobs.get()
        if pipeline is None:
            assert setup is not None
            robot, motion, how, seed = setup
            pipeline = PlanningPipeline(RobotModel.load(robot), motion, how, seed=seed)
        scene = new or scene
        assert scene is not None
        pipe.send(pipeline.plan(request, scene, current, cancel, (), width))


def _listen(pipe: Connection, jobs: queue.SimpleQueue[tuple[Job, Cancel]]) -> None:
    number, cancel = 0, Cancel()
    try:
        while True:
            told = pipe.recv()
            if not isinstance(told, int):
                number, cancel = told[0], Cancel()
                jobs.put((told, cancel))
            elif told == number:
                cancel.set()
    except (EOFError, OSError):
        os._exit(0)  # in the middle of a plan as well
