"""OperatorModel who come between in a simulated cell: they stop, start, slow down and move the robot at bad moments."""

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
from common.control.jogging import DEADMAN, STANDS
from common.errors import RequestFailed
from common.messages import JointState, PlanningScene
from common.planning.collision import CollisionWorld
from common.planning.obstacles import ObstacleCache
from common.planning.robot_geometry import RobotGeometry
from common.process.persist import persist
from common.robot.model import RobotModel
from common.topics import Request, Topic
from common.transport.reader import Reader
from lab.faults import Fault
from lab.loop import Incarnation, context_of
from lab.processes import SimulatedBus, SimulatedHost

AGAIN = 0.1  # [s] between looks whether something has come about
PERSON, PAGE = "person", "page"
EXECUTOR = "trajectory_executor"
SPEED = f"services.{EXECUTOR}.speed_scaling"
SLOWEST, SLOW = 0.1, 0.4  # share of the speed that a person sets
HOLD_SHARE = 0.25  # of those who end motion: with a hold of their own
LEFT_SHARE = 0.2  # of those who end motion: nobody starts the task again
VICTIM_SHARE = 0.7  # of task and executor, each, when a person has stopped the robot
LOOKS_ON = 3.0, 8.0  # [s] for which it rests then
PERSON_TIMEOUT = 2.0  # [s] of a person's request
SURE = 2.5  # [s] after which a person looks again: what was read may have been older than the stop
PERSON_SLOW = 0.3  # [s] that a message takes to or from a person on average, at most
START_LATE = 0.3, 1.0  # [s] by which a start comes late when somebody stops the robot meanwhile
GOAL_LATE = 0.5, 1.8  # [s] by which the goal comes late that a person gives up: less than what is refused as too old
JOGS, MOST_JOG = 4, 40  # of a person, and messages in each
JOG_PERIOD, JOG_GAP = 0.02, 0.5  # [s] between those, and at most between two of them
JOG_LATE = 0.3  # [s] after which a jog command does nothing any more, nor a person who has not seen the arm for so long
PERSON_LATE = 1.0  # [s] at most between a person's stop and what is done next, in two places at once

Act = Callable[[SimulatedBus, Fault], Coroutine[Any, Any, None]]


class OperatorModel:
    """Do in one run what its plan says."""

    def __init__(
        self, host: SimulatedHost, seed: int, strange: np.random.Generator, status: Topic[Any],
        tell: Callable[[str], None], made: Counter[str],
    ) -> None:
        """Prepare.

        Args:
            host: of the processes of the cell.
            seed: decides what the plan leaves open.
            strange: random numbers that others draw from as well.
            status: of the cell's task.
            tell: is called with a line for each fault.
            made: counts them.
        """
        self.leave: Callable[[], None] = lambda: None  # is called when whoever ended motion goes away
        self._host, self._network = host, host.network
        self._strange, self._status, self._tell, self._made = strange, status, tell, made
        self._random = np.random.default_rng([seed, 6])
        self._ends = np.random.default_rng([seed, 8])
        self._late = np.random.default_rng([seed, 12])
        self.acts: dict[str, tuple[int, str, Act]] = {  # number of the first session, what is told, what they do
            "person": (0, "stops the task, moves the arm home, and starts the task again", self._be_person),
            "ended": (1000, "", self._end_and_start),
            "slowed": (2000, "", self._slow_down),
            "stopped again": (3000, "a person stops the robot while a start is on its way", self._stop_again),
            "gave up": (4000, "a person asks for a motion and gives up before that is heard", self._give_up),
            "taken over": (5000, "a person takes the motion over, jogs the arm, and starts the task", self._take_over),
        }

    @property
    def _executor(self) -> str:
        return next(entry.name for entry in self._host.cell.services.values() if entry.kind == EXECUTOR)

    def begin(self, fault: Fault) -> asyncio.Task[None]:
        """Have somebody begin what a fault says."""
        number, told, act = self.acts[fault.kind]
        if told:
            self._tell(f"FAULT {fault.kind}: {told}")
        context = context_of(Incarnation(PERSON))
        session = self._network.attach(context, PERSON, number + self._made[fault.kind])

        async def be() -> None:
            bus = SimulatedBus(session, PERSON, self._host.cell.name, self._host.clock, self._host.requests)
            try:
                await act(bus, fault)
            finally:
                await bus.close()
                self._network.detach(session)

        return context.run(lambda: asyncio.create_task(be()))

    async def _stop_again(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Start the task; stop the robot while that is on its way; start it again some time later."""
        host, random = self._host, self._late
        command, heard_of = bus.client(topics.TASK_COMMAND), bus.reader(topics.MOTION_STATUS)
        seconds = float(random.uniform(*START_LATE))

        async def start() -> None:
            acknowledged = heard_of.latest.newest if heard_of.latest else 0
            with contextlib.suppress(RequestFailed):
                await command.call(m.TaskCommand(command="start", acknowledged=acknowledged), PERSON_TIMEOUT)

        with contextlib.suppress(RequestFailed):
            await command.wait_available(PERSON_TIMEOUT)
        if (task := self._host.processes[host.cell.task].session) is not None:
            self._network.hold_up(bus.session, task, f"{host.cell.name}/{topics.TASK_COMMAND.key}", seconds)
        starting = asyncio.create_task(start())
        await asyncio.sleep(seconds * float(random.random()))
        await _insist(bus, topics.MOTION_STOP, m.StopRequest(owner=PAGE))
        await starting
        await asyncio.sleep(float(random.uniform(*LOOKS_ON)))
        await self._start(bus, heard_of)

    async def _give_up(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Stop the task; send the arm home, which comes late; give that up; start the task."""
        host, random = self._host, self._late
        heard_of, motion = bus.reader(topics.MOTION_STATUS), OperatorMotion(bus, [bus.reader(self._status)])
        await _insist(bus, topics.TASK_COMMAND, m.TaskCommand(command="stop"))
        seconds = float(random.uniform(*GOAL_LATE))
        if (controller := host.processes[self._executor].session) is not None:
            self._network.hold_up(bus.session, controller, f"{host.cell.name}/{topics.MOTION_EXECUTE.key}", seconds)
        with contextlib.suppress(MotionFailed, RequestFailed, TimeoutError):
            async with asyncio.timeout(seconds * float(random.uniform(0.5, 1.0))):
                await motion.move(m.JointGoal(named="home"))
        await asyncio.sleep(GOAL_LATE[1])
        await self._start(bus, heard_of)

    async def _take_over(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Take the motion over, jog joints as far as nothing is in the way, and start the task, which hands it over."""
        host, random = self._host, self._late
        heard_of, jogs = bus.reader(topics.MOTION_STATUS), bus.writer(topics.MOTION_JOG)
        states, scenes = bus.reader(topics.JOINT_STATES), bus.reader(topics.PLANNING_SCENE)
        joints, sight, speed = host.cell.robot.joints, ClearanceCheck(host.cell), host.clock.speed

        def clear(velocities: dict[str, float]) -> bool:
            """Whether the arm would come to rest before anything in its way, however late this command comes."""
            state, scene = states.latest, scenes.latest
            if state is None or scene is None:
                return False
            age = max(0.0, (bus.header().stamp - state.header.stamp) * 1e-9)
            rests = (JOG_LATE + DEADMAN + STANDS) * speed
            return age < JOG_LATE * speed and sight.clear(state, scene, velocities, age + rests)

        await _insist(bus, topics.MOTION_OWN, m.OwnRequest(act="take", owner=m.UNKNOWN_OPERATOR, over=True))
        for _ in range(JOGS):
            velocities = {str(random.choice(joints)): float(random.uniform(-1.0, 1.0))}
            for _ in range(int(random.integers(1, MOST_JOG))):
                if not clear(velocities):
                    break
                acknowledged = heard_of.latest.newest if heard_of.latest else 0
                jogs.put(m.JogCommand(header=bus.header(), acknowledged=acknowledged, joints=velocities))
                await asyncio.sleep(JOG_PERIOD)
            await asyncio.sleep(float(random.uniform(0.0, JOG_GAP)))
        await self._start(bus, heard_of)

    async def _slow_down(self, bus: SimulatedBus, fault: Fault) -> None:
        """Set the speed, and set it back some time later."""
        share = float(self._strange.uniform(SLOWEST, SLOW))
        self._tell(f"FAULT slowed: to {share:.0%} for {fault.seconds:.1f} s")
        for speed in (share, 1.0):
            asked = m.ParameterRequest(set={SPEED.replace(EXECUTOR, self._executor): speed})
            await _insist(bus, topics.parameters_of(self._executor), asked)
            await asyncio.sleep(fault.seconds)

    async def _end_and_start(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Stop or pause the robot; let those crash who could start it again; start it some time later."""
        host, random = self._host, self._ends
        heard_of = bus.reader(topics.MOTION_STATUS)
        ends = str(random.choice(["stop", "task stop", "task pause"]))
        if self._strange.random() < HOLD_SHARE:
            ends = "hold"
        leaves = self._strange.random() < LEFT_SHARE
        victims = [name for name in (self._executor, host.cell.task) if random.random() < VICTIM_SHARE]
        self._tell(f"FAULT ended: {ends}, then {' and '.join(victims) or 'nobody'} crashes"
                   f"{'; nobody starts it again' if leaves else ''}")
        if ends == "hold":
            await _insist(bus, topics.MOTION_HOLD, m.HoldRequest(hold=True))
        elif ends == "stop":
            await _insist(bus, topics.MOTION_STOP, m.StopRequest(owner=PAGE))
        else:
            said = m.TaskCommand(command="pause" if ends == "task pause" else "stop")
            await _insist(bus, topics.TASK_COMMAND, said)
        for name in victims:
            host.processes[name].kill()
        await asyncio.sleep(float(random.uniform(*LOOKS_ON)))
        if leaves:
            self._made["left so"] += 1
            self.leave()
            return
        await self._start(bus, heard_of)

    async def _start(self, bus: SimulatedBus, motion: Reader[m.MotionStatus]) -> None:
        """Start the task as a person does: again, as long as the robot stays stopped."""
        status = bus.reader(self._status)
        while True:
            acknowledged = motion.latest.newest if motion.latest else 0  # who has heard nothing lets go of nothing
            await _insist(bus, topics.TASK_COMMAND, m.TaskCommand(command="start", acknowledged=acknowledged))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(PERSON_TIMEOUT):
                    while not _started(status.latest, motion.latest):  # noqa: ASYNC110 - time is free here
                        await asyncio.sleep(AGAIN)
            await asyncio.sleep(SURE)
            if _started(status.latest, motion.latest):
                return

    async def _be_person(self, bus: SimulatedBus, _fault: Fault) -> None:
        """Stop the task; then send the arm home and start the task, from two places that know nothing of each other."""
        bus.session.slow = float(self._random.uniform(0.0, PERSON_SLOW))
        command, heard_of = bus.client(topics.TASK_COMMAND), bus.reader(topics.MOTION_STATUS)
        motion = OperatorMotion(bus, [bus.reader(self._status)])

        async def go_home() -> None:
            await asyncio.sleep(float(self._random.uniform(0.0, PERSON_LATE)))
            with contextlib.suppress(MotionFailed, RequestFailed):
                await motion.move(m.JointGoal(named="home"))

        with contextlib.suppress(RequestFailed):
            await command.call(m.TaskCommand(command="stop"), PERSON_TIMEOUT)
        async with asyncio.TaskGroup() as group:
            group.create_task(go_home())
            await asyncio.sleep(float(self._random.uniform(0.0, PERSON_LATE)))
            await self._start(bus, heard_of)


def _started(task: m.TaskStatus | None, motion: m.MotionStatus | None) -> bool:
    """Whether nothing that a person said keeps the task any more."""
    kept = motion is None or any(interlock.by in (m.UNKNOWN_OPERATOR, PAGE) for interlock in motion.interlocks)
    return task is not None and task.started and not kept


async def _insist(bus: SimulatedBus, request: Request[Any, Any], message: m.Message) -> None:
    """Ask until there is an answer, whatever it is."""
    await persist(bus.client(request), message, PERSON_TIMEOUT, lambda error: None, lambda problem: None)


class ClearanceCheck:
    """Looks where an arm would go that is jogged.

    A jogged arm goes where it is told, and a simulated one goes through what a real one would run into: nobody could
    bring it away from there, because from inside a solid there is no plan.
    """

    def __init__(self, cell: Cell) -> None:
        """Know the arm."""
        self._robot = RobotModel.load(cell.robot)
        self._cache = ObstacleCache(RobotGeometry(self._robot))
        self._gripper = cell.robot.gripper.links if cell.robot.gripper else []
        self._padding = cell.motion.object_padding

    def clear(self, state: JointState, scene: PlanningScene, asked: Mapping[str, float], seconds: float) -> bool:
        """Whether the arm touches nothing that a retreat would not free it from, if it went on for so long.

        Args:
            state: of the arm when it was seen last.
            scene: what stands around.
            asked: velocities of joints [rad/s]; the others go on until they rest.
            seconds: of cell time.
        """
        robot, names = self._robot, self._robot.joint_names
        q, dq = dict(zip(state.name, state.position, strict=True)), dict(zip(state.name, state.velocity, strict=False))
        if not all(name in q for name in names):
            return False
        start = np.array([q[name] for name in names])
        ahead = start + seconds * np.array([asked.get(name, dq.get(name, 0.0)) for name in names])
        fingers = [(link, thing.id) for link in self._gripper for thing in scene.objects if thing.role == "target"]
        world = CollisionWorld(robot, scene, start=start, padding=self._padding, allowed=fingers, cache=self._cache)
        return not world.collides(start) and world.edge_free(start, np.clip(ahead, robot.lower, robot.upper))
