"""Model of operators of a simulated cell: they stop, start, slow down and move the robot at bad moments."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

import numpy as np

from common import messages as m
from common import topics
from common.client.operator_motion import MotionFailed, OperatorMotion
from common.config import Cell
from common.control.jogging import BRAKING_TIME, DEADMAN
from common.errors import RequestFailed
from common.planning.collision import CollisionWorld
from common.planning.obstacles import ObstacleCache
from common.planning.robot_geometry import RobotGeometry
from common.process.timing import call_until_answered
from common.robot.model import RobotModel
from common.topics import Request, Topic
from common.transport.reader import Reader
from lab.faults import Fault
from lab.loop import Incarnation, context_of
from lab.processes import SimulatedBus, SimulatedHost

POLL = 0.1  # [s] between checks of a condition
OPERATOR, PAGE = "operator", "page"  # sessions
NAME = "anna"  # of the operator, who moves the arm without the page
EXECUTOR = "trajectory_executor"
SPEED = f"services.{EXECUTOR}.speed_scaling"
SLOWEST, SLOW = 0.1, 0.4  # speed that an operator sets, share of the full speed
HOLD_SHARE = 0.25  # of the operator stops: by a hold
LEFT_SHARE = 0.2  # of the operator stops: the task is not started again
VICTIM_SHARE = 0.7  # probability that the task, and the executor, crashes after an operator stop
WAIT = 3.0, 8.0  # [s] at standstill before the next start
TIMEOUT = 2.0  # [s] of an operator's request
CONFIRM = 2.5  # [s] after which a start is verified: the status read before may have been older than the stop
MOST_SLOW = 0.3  # [s] largest mean delay of the messages to and from an operator
START_LATE = 0.3, 1.0  # [s] delay of a start during which the robot is stopped
GOAL_LATE = 0.5, 1.8  # [s] delay of a goal that is abandoned: shorter than the age at which goals are refused
JOGS, MOST_JOG = 4, 40  # jog motions, and messages in each
JOG_PERIOD, JOG_GAP = 0.02, 0.5  # [s] between jog messages, and at most between jog motions
JOG_LATE = 0.3  # [s] age at which a jog command expires, and oldest joint state by which an operator jogs
MOST_LATE = 1.0  # [s] at most between an operator's stop and each of two concurrent further actions

Act = Callable[[SimulatedBus, Fault], Coroutine[Any, Any, None]]


class OperatorModel:
    """Plays the operators of a fault plan."""

    def __init__(
        self, host: SimulatedHost, seed: int, shared_random: np.random.Generator, status: Topic[Any],
        log: Callable[[str], None], injected: Counter[str],
    ) -> None:
        """Prepare the operators.

        Args:
            host: runs the processes of the cell.
            seed: decides what the plan leaves open.
            shared_random: generator that other faults draw from too.
            status: topic of the cell's task.
            log: called with a line for each fault.
            injected: counts the faults by kind.
        """
        self.on_leave: Callable[[], None] = lambda: None  # called when an operator stops the robot and leaves
        self._host, self._network = host, host.network
        self._shared_random, self._status, self._log, self._injected = shared_random, status, log, injected
        self._restarts = np.random.default_rng([seed, 6])
        self._stops = np.random.default_rng([seed, 8])
        self._late = np.random.default_rng([seed, 12])
        self.acts: dict[str, tuple[int, str, Act]] = {  # number of the first session, log line, action
            "operator": (0, "stops the task, moves the arm home, and starts the task again", self._restart_task),
            "operator stop": (1000, "", self._stop_and_start),
            "speed change": (2000, "", self._slow_down),
            "late start": (3000, "the operator stops the robot while a start is on its way", self._stop_late_start),
            "abandoned goal": (4000, "the operator requests a motion and cancels before it arrives", self._abandon),
            "takeover": (5000, "the operator takes motion ownership, jogs, and starts the task", self._take_over),
        }

    @property
    def _executor(self) -> str:
        return next(entry.name for entry in self._host.cell.services.values() if entry.kind == EXECUTOR)

    def start(self, fault: Fault) -> asyncio.Task[None]:
        """Let an operator do what a fault says, on a session of its own."""
        number, line, act = self.acts[fault.kind]
        if line:
            self._log(f"FAULT {fault.kind}: {line}")
        context = context_of(Incarnation(OPERATOR))
        session = self._network.attach(context, OPERATOR, number + self._injected[fault.kind])

        async def run() -> None:
            bus = SimulatedBus(session, OPERATOR, self._host.cell.name, self._host.clock, self._host.requests)
            try:
                await act(bus, fault)
            finally:
                await bus.close()
                self._network.detach(session)

        return context.run(lambda: asyncio.create_task(run()))

    async def _stop_late_start(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Start the task, stop the robot while the start is on its way, and start again later."""
        host, random = self._host, self._late
        command, motion = bus.client(topics.TASK_COMMAND), bus.reader(topics.MOTION_STATUS)
        seconds = float(random.uniform(*START_LATE))

        async def start() -> None:
            request = m.TaskCommand(command="start", by=NAME, acknowledged=_newest_interlock(motion))
            with contextlib.suppress(RequestFailed):
                await command.call(request, TIMEOUT)

        with contextlib.suppress(RequestFailed):
            await command.wait_available(TIMEOUT)
        if (task := self._host.processes[host.cell.task].session) is not None:
            self._network.delay_next_query(bus.session, task, f"{host.cell.name}/{topics.TASK_COMMAND.key}", seconds)
        starting = asyncio.create_task(start())
        await asyncio.sleep(seconds * float(random.random()))
        await _call_until_answered(bus, topics.MOTION_STOP, m.StopRequest(owner=PAGE))
        await starting
        await asyncio.sleep(float(random.uniform(*WAIT)))
        await self._start_task(bus, motion)

    async def _abandon(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Stop the task, send the arm home by a delayed goal, cancel that, and start the task."""
        host, random = self._host, self._late
        status, motion = bus.reader(topics.MOTION_STATUS), OperatorMotion(bus, [bus.reader(self._status)], NAME)
        await _call_until_answered(bus, topics.TASK_COMMAND, m.TaskCommand(command="stop", by=NAME))
        seconds = float(random.uniform(*GOAL_LATE))
        if (executor := host.processes[self._executor].session) is not None:
            key = f"{host.cell.name}/{topics.MOTION_EXECUTE.key}"
            self._network.delay_next_query(bus.session, executor, key, seconds)
        with contextlib.suppress(MotionFailed, RequestFailed, TimeoutError):
            async with asyncio.timeout(seconds * float(random.uniform(0.5, 1.0))):
                await motion.move(m.JointGoal(named="home"))
        await asyncio.sleep(GOAL_LATE[1])
        await self._start_task(bus, status)

    async def _take_over(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Take motion ownership, jog joints while they are clear, and start the task, which takes it back."""
        host, random = self._host, self._late
        motion, jogs = bus.reader(topics.MOTION_STATUS), bus.writer(topics.MOTION_JOG)
        states, scenes = bus.reader(topics.JOINT_STATES), bus.reader(topics.PLANNING_SCENE)
        joints, clearance, speed = host.cell.robot.joints, ClearanceCheck(host.cell), host.clock.speed

        def clear(velocities: dict[str, float]) -> bool:
            """Return whether the arm would stop before any obstacle, however late this command arrives."""
            state, scene = states.latest, scenes.latest
            if state is None or scene is None:
                return False
            age = max(0.0, (bus.header().stamp - state.header.stamp) * 1e-9)
            until_standstill = (JOG_LATE + DEADMAN + BRAKING_TIME) * speed
            return age < JOG_LATE * speed and clearance.clear(state, scene, velocities, age + until_standstill)

        take = m.OwnRequest(act="take", owner=NAME, over=True)
        await _call_until_answered(bus, topics.MOTION_OWN, take)
        for _ in range(JOGS):
            velocities = {str(random.choice(joints)): float(random.uniform(-1.0, 1.0))}
            for _ in range(int(random.integers(1, MOST_JOG))):
                if not clear(velocities):
                    break
                acknowledged = _newest_interlock(motion)
                jogs.put(m.JogCommand(header=bus.header(), owner=NAME, acknowledged=acknowledged, joints=velocities))
                await asyncio.sleep(JOG_PERIOD)
            await asyncio.sleep(float(random.uniform(0.0, JOG_GAP)))
        await self._start_task(bus, motion)

    async def _slow_down(self, bus: SimulatedBus, fault: Fault) -> None:
        """Lower the speed, and restore it later."""
        share = float(self._shared_random.uniform(SLOWEST, SLOW))
        self._log(f"FAULT speed change: to {share:.0%} for {fault.seconds:.1f} s")
        for speed in (share, 1.0):
            request = m.ParameterRequest(set={SPEED.replace(EXECUTOR, self._executor): speed})
            await _call_until_answered(bus, topics.parameters_of(self._executor), request)
            await asyncio.sleep(fault.seconds)

    async def _stop_and_start(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Stop, pause or hold the robot, crash task or executor, and start the task again later."""
        host, random = self._host, self._stops
        motion = bus.reader(topics.MOTION_STATUS)
        how = str(random.choice(["stop", "task stop", "task pause"]))
        if self._shared_random.random() < HOLD_SHARE:
            how = "hold"
        leaves = self._shared_random.random() < LEFT_SHARE
        victims = [name for name in (self._executor, host.cell.task) if random.random() < VICTIM_SHARE]
        crashes = f"crash of {' and '.join(victims)}" if victims else "no crash"
        self._log(f"FAULT operator stop: {how}, then {crashes}{'; the task is not started again' if leaves else ''}")
        if how == "hold":
            await _call_until_answered(bus, topics.MOTION_HOLD, m.HoldRequest(hold=True))
        elif how == "stop":
            await _call_until_answered(bus, topics.MOTION_STOP, m.StopRequest(owner=PAGE))
        else:
            command = m.TaskCommand(command="pause" if how == "task pause" else "stop")
            await _call_until_answered(bus, topics.TASK_COMMAND, command)
        for name in victims:
            host.processes[name].kill()
        await asyncio.sleep(float(random.uniform(*WAIT)))
        if leaves:
            self._injected["left stopped"] += 1
            self.on_leave()
            return
        await self._start_task(bus, motion)

    async def _start_task(self, bus: SimulatedBus, motion: Reader[m.MotionStatus]) -> None:
        """Start the task as an operator does: repeat until it runs and no operator's interlock is left."""
        status = bus.reader(self._status)
        while True:
            command = m.TaskCommand(command="start", by=NAME, acknowledged=_newest_interlock(motion))
            await _call_until_answered(bus, topics.TASK_COMMAND, command)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TIMEOUT):
                    while not _started(status.latest, motion.latest):  # noqa: ASYNC110 - time is free here
                        await asyncio.sleep(POLL)
            await asyncio.sleep(CONFIRM)
            if _started(status.latest, motion.latest):
                return

    async def _restart_task(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Stop the task, then send the arm home and start the task concurrently, as from two independent clients."""
        bus.session.slow = float(self._restarts.uniform(0.0, MOST_SLOW))
        command, status = bus.client(topics.TASK_COMMAND), bus.reader(topics.MOTION_STATUS)
        motion = OperatorMotion(bus, [bus.reader(self._status)], NAME)

        async def go_home() -> None:
            await asyncio.sleep(float(self._restarts.uniform(0.0, MOST_LATE)))
            with contextlib.suppress(MotionFailed, RequestFailed):
                await motion.move(m.JointGoal(named="home"))

        with contextlib.suppress(RequestFailed):
            await command.call(m.TaskCommand(command="stop", by=NAME), TIMEOUT)
        async with asyncio.TaskGroup() as group:
            group.create_task(go_home())
            await asyncio.sleep(float(self._restarts.uniform(0.0, MOST_LATE)))
            await self._start_task(bus, status)


def _newest_interlock(motion: Reader[m.MotionStatus]) -> int:
    """Return the id of the newest interlock that was read; 0 acknowledges none."""
    return motion.latest.newest if motion.latest else 0


def _started(task: m.TaskStatus | None, motion: m.MotionStatus | None) -> bool:
    """Return whether the task runs and no operator's interlock blocks it."""
    blocked = motion is None or any(interlock.by in (m.UNKNOWN_OPERATOR, NAME, PAGE) for interlock in motion.interlocks)
    return task is not None and task.started and not blocked


async def _call_until_answered(bus: SimulatedBus, request: Request[Any, Any], message: m.Message) -> None:
    """Repeat a request until there is any answer."""
    await call_until_answered(bus.client(request), message, TIMEOUT, lambda error: None, lambda problem: None)


class ClearanceCheck:
    """Checks whether a jogged arm stays clear of obstacles.

    Nothing checks a jogged arm for obstacles, and a simulated one passes through solids. From inside a solid there is
    no plan, so the arm could never leave it.
    """

    def __init__(self, cell: Cell) -> None:
        """Load the robot of a cell."""
        self._robot = RobotModel.load(cell.robot)
        self._cache = ObstacleCache(RobotGeometry(self._robot))
        self._gripper = cell.robot.gripper.links if cell.robot.gripper else []
        self._padding = cell.motion.object_padding

    def clear(
        self, state: m.JointState, scene: m.PlanningScene, velocities: Mapping[str, float], seconds: float
    ) -> bool:
        """Return whether the arm is free of collisions now and along its motion.

        Args:
            state: newest state of the arm.
            scene: obstacles.
            velocities: requested joint velocities [rad/s]; other joints keep their measured velocity.
            seconds: duration of the motion in cell time [s].
        """
        robot, names = self._robot, self._robot.joint_names
        q, dq = dict(zip(state.name, state.position, strict=True)), dict(zip(state.name, state.velocity, strict=False))
        if not all(name in q for name in names):
            return False
        start = np.array([q[name] for name in names])
        ahead = start + seconds * np.array([velocities.get(name, dq.get(name, 0.0)) for name in names])
        fingers = [(link, item.id) for link in self._gripper for item in scene.objects if item.role == "target"]
        world = CollisionWorld(robot, scene, start=start, padding=self._padding, allowed=fingers, cache=self._cache)
        return not world.collides(start) and world.edge_free(start, np.clip(ahead, robot.lower, robot.upper))
