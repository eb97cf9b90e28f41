"""A second planner in a process of its own, for requests that come while the first one is at work.

It is forked with all modules loaded, before its parent has begun anything: until it is needed it takes no time, and
30 MB. Threads would not do: two thirds of an easy plan are Python's.
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
from common.process.environment import usable_cores
from common.process.lifeline import die_when_orphaned
from common.robot.model import RobotModel

LOOK = 0.005  # [s] between looks at whether somebody gave up
PATIENCE = 30.0  # [s] beyond the time for planning, in which the robot may be loaded; also after giving up was told
MOST = 3

Setup = tuple[list[str], RobotConfig, Motion, Pipeline, int]  # where modules are found, and how to plan
Job = tuple[int, Setup | None, PlanRequest, PlanningScene | None, list[float] | None, float | None]


class HelperLost(ZencellError):
    """The process has ended; what it said of that is on stderr."""


class Helper:
    """This end of the pipe to the process. One plan at a time."""

    def __init__(self, niceness: int = 0) -> None:
        """Fork the process, by so much nicer than this one, in which nothing may run yet but the main thread."""
        self._pipe, theirs = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("fork").Process(
            target=_be, args=(theirs, self._pipe, niceness), name="helper", daemon=True)
        self._process.start()
        theirs.close()
        self._setup: Setup | None = None
        self._usual = 0.0  # [s] for planning where a request does not say
        self._scene: PlanningScene | None = None
        self._asked = 0

    def set_up(self, robot: RobotConfig, motion: Motion, pipeline: Pipeline, *, seed: int) -> None:
        """Say how to plan; the robot is loaded when the first request comes."""
        self._setup = (list(sys.path), robot, motion, pipeline, seed)
        self._usual = motion.planning_time

    def plan(
        self, request: PlanRequest, scene: PlanningScene, current: list[float] | None, cancel: Cancel,
        width: float | None = None,
    ) -> PlanResponse:
        """The answer of a `PlanningPipeline` to the same; waits for it.

        Raises:
            HelperLost: the process has ended, or was ended because it did not answer for much too long.
        """
        self._asked += 1
        new, told = None if scene is self._scene else scene, False
        limits = [self._end_after((request.planning_time or self._usual) + PATIENCE)]
        try:
            self._pipe.send((self._asked, self._setup, request, new, current, width))
            self._setup, self._scene = None, scene
            while not self._pipe.poll(LOOK):
                if cancel.is_set and not told:
                    told = True
                    limits.append(self._end_after(PATIENCE))
                    self._pipe.send(self._asked)
            response: PlanResponse = self._pipe.recv()
        except (EOFError, OSError):
            self.close()
            raise HelperLost("the second planner has ended") from None
        finally:
            for limit in limits:
                limit.cancel()
        return response

    def close(self) -> None:
        """End the process, whatever it does."""
        self._pipe.close()
        self._process.kill()
        self._process.join()

    def _end_after(self, seconds: float) -> threading.Timer:
        """Have the process ended if it is stuck or stopped: nobody waits for it without end, not even to send."""
        limit = threading.Timer(seconds, self._process.kill)
        limit.daemon = True
        limit.start()
        return limit


def fork_helpers(niceness: int) -> list[Helper]:
    """As many as leave half of the cores to others, at least one; none where forking is not safe."""
    if sys.platform != "linux":
        return []
    return [Helper(niceness) for _ in range(min(MOST, max(1, int(usable_cores()) // 2 - 1)))]


def _be(pipe: Connection, of_parent: Connection, niceness: int) -> None:
    """Be the process, until the other end of the pipe is gone."""
    of_parent.close()
    die_when_orphaned()  # the end of the pipe tells nothing to who is stopped, and who was forked later has it
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
            sys.path[:], robot, motion, how, seed = setup
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
