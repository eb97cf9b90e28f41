"""Requests chunks from a policy, proves them, and passes the motions to the task. One chunk at a time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from applications.policy.decoding import decode
from applications.policy.interface import MotionState, Observation, PolicyFailed, PolicySource, ProvedMotion
from applications.policy.observation import Missing, ObservationBuffer
from applications.policy.proof import ChunkProver
from applications.policy.proof_space import ProverUnavailable
from applications.policy.runner import PolicyTask
from applications.policy.settings import Config
from common.clock import Clock
from common.errors import Refused
from common.hardware.interface import Limits
from common.messages import PlanningScene
from common.planning.obstacles import InvalidShape
from common.planning.point_obstacles import PointObstacle
from common.robot.model import RobotModel
from common.tasks.stages import View
from common.time_source import monotonic

Array = NDArray[np.float64]
Points = Callable[[], list[PointObstacle]]

POLL = 0.01  # [s, cell time] between looks at what is known
BACKOFF, LONGEST_BACKOFF = 0.1, 1.0  # [s, wall time] after a failure; doubled with each further one
USUAL_SHARE = 0.2  # weight of the newest delay in the mean
STILL = 0.01  # [rad/s] an arm that is slower was observed at rest
NO_IMAGE = "no observation: "


class ChunkLoop:
    """Observes, asks the policy, and proves its answers, as long as the task wants chunks."""

    def __init__(
        self, config: Config, limits: Limits, task: PolicyTask, source: PolicySource, clock: Clock,
        observe: Callable[[], View], wake: Callable[[], None], points: Callable[[PlanningScene], Points] | None = None,
    ) -> None:
        """Load the models of the robot: for decoding and for the proof, each for one thread at a time.

        Args:
            config: of the service.
            limits: of the arm, as the executor checks them.
            task: wants chunks, and sends the motions.
            source: of the chunks.
            clock: of the cell.
            observe: returns what is known now.
            wake: called after each motion.
            points: returns a function for a thread that computes what cameras see beyond the scene; None: nothing.
        """
        self._p, self._task, self._source, self._clock = config, task, source, clock
        self._observe, self._wake, self._points = observe, wake, points
        self._robot = RobotModel.load(config.robot)
        self._prover = ChunkProver(RobotModel.load(config.robot), limits, config.proof_options())
        gripper = config.robot.gripper
        self._widest = gripper.max_width if gripper is not None else None
        self.buffer = ObservationBuffer(
            self._robot, list(config.cameras), image_size=config.image_size, tolerance=config.image_tolerance,
            max_age=config.observation_age, gripper=gripper is not None)
        self._proved_in: PlanningScene | None = None
        self._rate = config.source.actions.rate
        self._inferring = self._proving = 0.0  # mean delays [s, wall time]
        self._newest = 0  # stamp of the observation that was used last
        self._failures = 0

    async def run(self) -> None:
        """Run until cancelled."""
        try:
            while True:
                try:
                    await self._next()
                except (PolicyFailed, ProverUnavailable, InvalidShape, Refused) as error:
                    await self._fail(str(error))
        finally:
            await self._source.close()

    async def _fail(self, problem: str) -> None:
        self._task.status.failed += 1
        self._task.fail(problem)
        self._wake()
        await asyncio.sleep(min(BACKOFF * 2 ** min(self._failures, 10), LONGEST_BACKOFF))
        self._failures += 1

    async def _next(self) -> None:
        """Do one round: from an observation to a motion.

        Raises:
            PolicyFailed: the policy returned no chunk, or one that cannot be decoded.
        """
        view = self._observe()
        observation = self._observation(view)
        if observation is None:
            await self._clock.sleep(POLL)
            return
        task, status = self._task, self._task.status
        path, speed = task.path, self._clock.speed
        earliest = task.expected_join(view.now, (self._inferring + self._proving) * speed)
        at_rest = path is None and bool((np.abs(observation.velocities) < STILL).all())
        if path is not None and earliest is not None:
            until = min(earliest, path.path.duration)
            committed = path.committed(observation.stamp * 1e-9, self._rate, until)
            observation = replace(observation, committed=committed)
        began = monotonic()
        chunk = await self._source.infer(observation)
        status.inference_ms = 1e3 * (inferring := monotonic() - began)
        self._inferring += USUAL_SHARE * (inferring - self._inferring)
        began = monotonic()
        rows, widths = await asyncio.to_thread(decode, chunk, observation, self._robot)
        status.chunks += 1
        self._failures, self._rate = 0, float(chunk.rate)
        view = self._observe()
        earliest = earliest if path is task.path else None
        join = task.join(chunk, len(rows), view, at_rest, self._proving * speed, earliest)
        ahead = rows[:0] if join is None else task.blended(rows, join)
        if join is None or len(ahead) == 0 or view.scene is None:
            status.late += 1
            await self._clock.sleep(POLL)
            return
        times = join.rows[join.ahead]
        points = None if self._points is None else self._points(view.scene)
        motion = await asyncio.to_thread(self._prove, join.state, ahead, times, view.scene, points)
        proving = monotonic() - began
        status.proof_ms = 1e3 * proving
        self._proving += USUAL_SHARE * (proving - self._proving)
        task.send(motion, join, widths, self._observe(), len(ahead))
        self._wake()

    def _observation(self, view: View) -> Observation | None:
        """Return the newest observation if it was not used yet, and the task wants a chunk."""
        status = self._task.status
        if view.missing or not self._task.wants_chunk(view):
            return None
        found = self.buffer.observe(self._clock.now_ns(), self._p.instruction)
        if isinstance(found, Missing):
            status.message = NO_IMAGE + found.message
            return None
        if status.message.startswith(NO_IMAGE):
            status.message = ""
        if found.stamp - self._newest < self._p.interval * 1e9:
            return None
        self._newest = found.stamp
        return found

    def _prove(
        self, state: MotionState, rows: Array, times: Array, scene: PlanningScene, points: Points | None
    ) -> ProvedMotion:
        if self._proved_in is not scene or points is not None:
            # With open fingers, which the planner assumes when it checks the motion again: they may open anywhere.
            self._prover.set_scene(scene, state.positions, () if points is None else points(), self._widest)
            self._proved_in = scene
        return self._prover.prove(state, rows, times)
