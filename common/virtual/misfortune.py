"""Makes the faults of a plan happen to a simulated cell, and plays the person who comes between."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import replace
from typing import Any

import numpy as np

from common import messages as m
from common import topics
from common.application import find_application
from common.chaos.agent import Chaos
from common.chaos.plan import Fault as Bad
from common.chaos.plan import Form
from common.client.operator_motion import MotionFailed, OperatorMotion
from common.control.jogging import DEADMAN, STANDS
from common.errors import RequestFailed
from common.process.persist import persist
from common.topics import Topic
from common.transport.reader import Reader
from common.virtual.faults import Amid, Fault, Plan
from common.virtual.loop import Life, context_of
from common.virtual.network import VirtualSession
from common.virtual.process import Host, VirtualBus, VirtualProcess
from common.virtual.sight import Sight

AGAIN = 0.1  # [s] between looks whether something has come about
LATEST = 0.3  # [s] after which a process crashes that does not get to the turn at which it was to
NEXT_GOAL = 1.5  # [s] for which the next goal is waited for
TURN = 0.0005  # [s] that stands for a turn where something is to happen just when a goal is asked for
GOALS = (topics.MOTION_EXECUTE.key, topics.GRIPPER_COMMAND.key)
PLAN = topics.MOTION_PLAN.key
PERSON, PAGE, STRANGER = "person", "page", "stranger"
EXECUTOR = "trajectory_executor"
SPEED = f"services.{EXECUTOR}.speed_scaling"
SLOWEST, SLOW = 0.1, 0.4  # share of the speed that a person sets
FORMS: tuple[Form, ...] = ("truncated", "flipped", "noise", "wrong type")
BAD_MESSAGES = 4  # under one key, at most
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

Act = Callable[[VirtualSession, Fault], Coroutine[Any, Any, None]]


class Misfortune:
    """Lets go wrong in one run what its plan says; `made` counts."""

    def __init__(
        self, host: Host, plan: Plan, seed: int, status: Topic[Any], tell: Callable[[str], None]
    ) -> None:
        """Prepare.

        Args:
            host: of the processes that are hit.
            plan: what goes wrong, and when.
            seed: decides what the plan leaves open.
            status: of the cell's task.
            tell: is called with a line for each fault.
        """
        self.made: Counter[str] = Counter()
        self.leave: Callable[[], None] = lambda: None  # is called when whoever ended motion goes away
        self.lose_supervisor: Callable[[], Awaitable[object]] = asyncio.Event().wait  # and bring the cell up again
        self._seconds: list[VirtualProcess] = []
        self._strange = np.random.default_rng([seed, 10])
        self._host, self._plan, self._status, self._tell = host, plan, status, tell
        self._network = host.network
        self._random = np.random.default_rng([seed, 6])
        self._ends = np.random.default_rng([seed, 8])
        self._late = np.random.default_rng([seed, 12])
        self._persons: dict[str, tuple[int, str, Act]] = {  # number of the first session, what is told, what they do
            "person": (0, "stops the task, moves the arm home, and starts the task again", self._be_person),
            "ended": (1000, "", self._end_and_start),
            "slowed": (2000, "", self._slow_down),
            "stopped again": (3000, "a person stops the robot while a start is on its way", self._stop_again),
            "gave up": (4000, "a person asks for a motion and gives up before that is heard", self._give_up),
            "taken over": (5000, "a person takes the motion over, jogs the arm, and starts the task", self._take_over),
        }

    async def run(self) -> None:
        """Return when all has happened; cancelled, nothing more does."""
        loop, speed = self._host.loop, self._plan.speed
        began, persons = loop.time(), list[asyncio.Task[None]]()
        begins = {"second instance": self._begin_second, "hostile": self._begin_strange,
                  **dict.fromkeys(self._persons, self._begin_person)}
        try:
            for fault in self._plan.faults:
                await asyncio.sleep(max(0.0, began + fault.at / speed - loop.time()))
                if fault.kind in begins:
                    self.made[fault.kind] += 1
                    persons.append(begins[fault.kind](fault))
                elif fault.kind == "supervisor lost":
                    persons.append(asyncio.create_task(self._lose_supervisor()))
                else:
                    await self._hit(fault)
            await asyncio.gather(*persons)
        finally:
            for person in persons:
                person.cancel()

    def _note(self, fault: Fault, name: str) -> None:
        by = "by" if fault.kind == "clock step" else "for"
        lasts = f" {by} {fault.seconds:.1f} s" if fault.seconds else ""
        self._tell(f"FAULT {fault.kind} {name}{f' amid a goal: {fault.amid}' if fault.amid else ''}{lasts}")
        self.made[fault.kind] += 1

    async def _hit(self, fault: Fault) -> None:
        loop, network = self._host.loop, self._network
        if fault.kind == "clock step":
            self._note(fault, "")
            loop.stepped_ns += round(fault.seconds * 1e9)
            return
        if fault.kind == "late goal":
            if await self._next_goal(fault.amid, fault.seconds) is not None:
                self._note(fault, "")
            return
        process, session = await self._victim(fault)
        if fault.kind == "crash":
            while not await self._crash(process, fault):  # it ended by itself meanwhile
                process, session = await self._victim(replace(fault, amid=""))
            return
        if fault.amid:
            await asyncio.sleep(fault.turns * TURN)
        self._note(fault, process.name if fault.target else "")
        if fault.kind in ("router lost", "cut"):
            # Of one that was let in while the network was split there would be two arms: that is no single cell.
            self._end_seconds(process.name if fault.kind == "cut" else "")
        if fault.kind == "router lost":
            network.lose_router()
            loop.call_later(fault.seconds, network.find_router)
        elif fault.kind == "cut":
            network.cut([session])
            loop.call_later(fault.seconds, self._mend, session)
        elif fault.kind == "stalled":
            network.stall(session, fault.seconds)
        else:
            process.terminate()

    async def _crash(self, process: VirtualProcess, fault: Fault) -> bool:
        """Whether the process crashed, at its turn or somewhat later."""
        life, pid = process.life, process.pid
        process.kill_at_turn(fault.turns)
        deadline = self._host.loop.time() + LATEST
        try:
            while not life.over and self._host.loop.time() < deadline:  # noqa: ASYNC110 - time is free here
                await asyncio.sleep(AGAIN)
        finally:
            life.at_turn = None
        if not life.over and process.pid == pid:
            process.kill()
        if life.over:
            self._note(fault, process.name)
        return life.over

    async def _victim(self, fault: Fault) -> tuple[VirtualProcess, VirtualSession]:
        """Whom a fault hits: who has to do with the next goal, its target, or another that runs."""
        processes = self._host.processes
        names = [fault.target, *processes]
        if fault.amid and (found := await self._next_goal()) is not None:
            asker, asked = found
            names = [asker, asked, *names] if fault.amid == "asker" else [asked, asker, *names]
        while True:
            for process in [processes[name] for name in names if name in processes]:
                session = process.session
                if session is not None and not (fault.kind == "cut" and session.cut):
                    return process, session
            await asyncio.sleep(AGAIN)

    async def _next_goal(self, late: Amid = "", seconds: float = 0.0) -> tuple[str, str] | None:
        """Who asks for the next goal or plan, and who is asked; None when nobody asks for a while.

        Args:
            late: whether what is sent by who asks, or by who is asked, is to be late: of a goal only.
            seconds: by how much [s].
        """
        requests = self._host.requests
        begun: asyncio.Future[tuple[str, str]] = asyncio.get_running_loop().create_future()

        def on_begin(asker: str, asked: str, key: str) -> None:
            if (key in GOALS or (key == PLAN and not late)) and not begun.done():
                begun.set_result((asker, asked))
                found = [self._host.processes.get(name) for name in (asker, asked)]
                ends = [session for process in found if process and (session := process.session) is not None]
                if late and len(ends) == 2:
                    source, target = ends if late == "asker" else reversed(ends)
                    self._network.hold_up(source, target, f"{self._host.cell.name}/{key}", seconds)

        requests.on_begin = on_begin
        try:
            async with asyncio.timeout(NEXT_GOAL):
                return await begun
        except TimeoutError:
            return None
        finally:
            requests.on_begin = lambda asker, asked, key: None

    def _mend(self, session: VirtualSession) -> None:
        if not session.detached and not self._network.router_lost:
            self._network.mend([session])

    # --- what nobody should do ----------------------------------------------------------------------------------------

    async def _lose_supervisor(self) -> None:
        self._tell("FAULT supervisor lost: the cell is brought up again")
        self.made["supervisor lost"] += 1
        self._end_seconds("")
        await self.lose_supervisor()

    def _begin_second(self, fault: Fault) -> asyncio.Task[None]:
        self._tell(f"FAULT second instance {fault.target} for {fault.seconds:.1f} s")
        return asyncio.create_task(self._be_second(fault))

    async def _be_second(self, fault: Fault) -> None:
        """Start a service that is up, as somebody might by hand; it is to end by itself, or when it is not needed."""
        entry = next(entry for entry in self._host.cell.services.values() if entry.name == fault.target)
        while (session := self._host.processes[fault.target].session) is None or session.cut:  # noqa: ASYNC110
            await asyncio.sleep(AGAIN)
        second = VirtualProcess(self._host, entry, lambda name, line: self._tell(f"second {name}: {line}"), beside=True)
        self._seconds.append(second)
        second.start()
        second.release()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(fault.seconds):
                    await second.wait()
        finally:
            second.terminate()
            self._seconds.remove(second)

    def _end_seconds(self, name: str) -> None:
        """End the second instances of a service, or all of them."""
        for second in self._seconds:
            if name in ("", second.name):
                second.kill()

    def _begin_strange(self, _fault: Fault) -> asyncio.Task[None]:
        self._tell("FAULT hostile: messages that nobody can read under all keys")
        context = context_of(Life(STRANGER))
        session = self._network.attach(context, STRANGER, self.made["hostile"])
        return context.run(lambda: asyncio.create_task(self._be_strange(session)))

    async def _be_strange(self, session: VirtualSession) -> None:
        """Put damaged messages and nonsense under every key, and ask for nonsense."""
        host, random = self._host, self._strange
        bus = VirtualBus(session, STRANGER, host.cell.name, host.clock, host.requests)
        known = {**topics.platform_topics(), **find_application(host.cell.application).topics}
        keys = [key for key in known if topics.SERVICE not in key]
        bad = [
            Bad(0.0, "corrupt", key, form=FORMS[int(random.integers(len(FORMS)))],
                count=int(random.integers(1, BAD_MESSAGES + 1)), seed=int(random.integers(2**31)))
            for key in [keys[i] for i in random.permutation(len(keys))]
        ]
        try:
            await Chaos(bus, bad, dict, None, known=known).run()
        finally:
            await bus.close()
            self._network.detach(session)

    # --- a person -----------------------------------------------------------------------------------------------------

    def _begin_person(self, fault: Fault) -> asyncio.Task[None]:
        number, told, act = self._persons[fault.kind]
        if told:
            self._tell(f"FAULT {fault.kind}: {told}")
        context = context_of(Life(PERSON))
        session = self._network.attach(context, PERSON, number + self.made[fault.kind])
        return context.run(lambda: asyncio.create_task(act(session, fault)))

    async def _stop_again(self, session: VirtualSession, _fault: Fault) -> None:
        """Start the task; stop the robot while that is on its way; start it again some time later."""
        host, random = self._host, self._late
        bus = VirtualBus(session, PERSON, host.cell.name, host.clock, host.requests)
        command, heard_of = bus.client(topics.TASK_COMMAND), bus.reader(topics.MOTION_STATUS)
        seconds = float(random.uniform(*START_LATE))

        async def start() -> None:
            heard = heard_of.latest.newest if heard_of.latest else 0
            with contextlib.suppress(RequestFailed):
                await command.call(m.TaskCommand(command="start", heard=heard), PERSON_TIMEOUT)

        try:
            with contextlib.suppress(RequestFailed):
                await command.wait_available(PERSON_TIMEOUT)
            if (task := self._host.processes[host.cell.task].session) is not None:
                self._network.hold_up(session, task, f"{host.cell.name}/{topics.TASK_COMMAND.key}", seconds)
            starting = asyncio.create_task(start())
            await asyncio.sleep(seconds * float(random.random()))
            await persist(bus.client(topics.MOTION_STOP), m.StopRequest(owner=PAGE), PERSON_TIMEOUT,
                          lambda error: m.MotionStatus(), lambda problem: None)
            await starting
            await asyncio.sleep(float(random.uniform(*LOOKS_ON)))
            await self._start(bus, heard_of)
        finally:
            await bus.close()
            self._network.detach(session)

    async def _give_up(self, session: VirtualSession, _fault: Fault) -> None:
        """Stop the task; send the arm home, which comes late; give that up; start the task."""
        host, random = self._host, self._late
        bus = VirtualBus(session, PERSON, host.cell.name, host.clock, host.requests)
        heard_of, motion = bus.reader(topics.MOTION_STATUS), OperatorMotion(bus, [bus.reader(self._status)])
        executor = next(entry.name for entry in host.cell.services.values() if entry.kind == EXECUTOR)
        try:
            await persist(bus.client(topics.TASK_COMMAND), m.TaskCommand(command="stop"), PERSON_TIMEOUT,
                          lambda error: m.TaskStatus(), lambda problem: None)
            seconds = float(random.uniform(*GOAL_LATE))
            if (controller := host.processes[executor].session) is not None:
                self._network.hold_up(session, controller, f"{host.cell.name}/{topics.MOTION_EXECUTE.key}", seconds)
            with contextlib.suppress(MotionFailed, RequestFailed, TimeoutError):
                async with asyncio.timeout(seconds * float(random.uniform(0.5, 1.0))):
                    await motion.move(m.JointGoal(named="home"))
            await asyncio.sleep(GOAL_LATE[1])
            await self._start(bus, heard_of)
        finally:
            await bus.close()
            self._network.detach(session)

    async def _take_over(self, session: VirtualSession, _fault: Fault) -> None:
        """Take the motion over, jog joints as far as nothing is in the way, and start the task, which hands it over."""
        host, random = self._host, self._late
        bus = VirtualBus(session, PERSON, host.cell.name, host.clock, host.requests)
        heard_of, jogs = bus.reader(topics.MOTION_STATUS), bus.writer(topics.MOTION_JOG)
        states, scenes = bus.reader(topics.JOINT_STATES), bus.reader(topics.PLANNING_SCENE)
        joints, sight, speed = host.cell.robot.joints, Sight(host.cell), host.clock.speed

        def clear(velocities: dict[str, float]) -> bool:
            """Whether the arm would come to rest before anything in its way, however late this command comes."""
            state, scene = states.latest, scenes.latest
            if state is None or scene is None:
                return False
            age = max(0.0, (bus.header().stamp - state.header.stamp) * 1e-9)
            rests = (JOG_LATE + DEADMAN + STANDS) * speed
            return age < JOG_LATE * speed and sight.clear(state, scene, velocities, age + rests)

        try:
            await persist(bus.client(topics.MOTION_OWN), m.OwnRequest(act="take", owner=PERSON, over=True),
                          PERSON_TIMEOUT, lambda error: m.MotionOwner(), lambda problem: None)
            for _ in range(JOGS):
                velocities = {str(random.choice(joints)): float(random.uniform(-1.0, 1.0))}
                for _ in range(int(random.integers(1, MOST_JOG))):
                    if not clear(velocities):
                        break
                    heard = heard_of.latest.newest if heard_of.latest else 0
                    jogs.put(m.JogCommand(header=bus.header(), owner=PERSON, heard=heard, joints=velocities))
                    await asyncio.sleep(JOG_PERIOD)
                await asyncio.sleep(float(random.uniform(0.0, JOG_GAP)))
            await self._start(bus, heard_of)
        finally:
            await bus.close()
            self._network.detach(session)

    async def _slow_down(self, session: VirtualSession, fault: Fault) -> None:
        """Set the speed, and set it back some time later."""
        host = self._host
        bus = VirtualBus(session, PERSON, host.cell.name, host.clock, host.requests)
        executor = next(entry.name for entry in host.cell.services.values() if entry.kind == EXECUTOR)
        client = bus.client(topics.parameters_of(executor))
        share = float(self._strange.uniform(SLOWEST, SLOW))
        self._tell(f"FAULT slowed: to {share:.0%} for {fault.seconds:.1f} s")
        try:
            for speed in (share, 1.0):
                asked = m.ParameterRequest(set={SPEED.replace(EXECUTOR, executor): speed})
                await persist(client, asked, PERSON_TIMEOUT,
                              lambda error: m.ParameterReply(service=executor, parameters=[]), lambda problem: None)
                await asyncio.sleep(fault.seconds)
        finally:
            await bus.close()
            self._network.detach(session)

    async def _end_and_start(self, session: VirtualSession, _fault: Fault) -> None:
        """Stop or pause the robot; let those crash who could start it again; start it some time later."""
        host, random = self._host, self._ends
        bus = VirtualBus(session, PERSON, host.cell.name, host.clock, host.requests)
        heard_of = bus.reader(topics.MOTION_STATUS)
        executor = next(entry.name for entry in host.cell.services.values() if entry.kind == EXECUTOR)
        ends = str(random.choice(["stop", "task stop", "task pause"]))
        if self._strange.random() < HOLD_SHARE:
            ends = "hold"
        leaves = self._strange.random() < LEFT_SHARE
        victims = [name for name in (executor, host.cell.task) if random.random() < VICTIM_SHARE]
        self._tell(f"FAULT ended: {ends}, then {' and '.join(victims) or 'nobody'} crashes"
                   f"{'; nobody starts it again' if leaves else ''}")
        try:
            if ends == "hold":
                await persist(bus.client(topics.MOTION_HOLD), m.HoldRequest(hold=True), PERSON_TIMEOUT,
                              lambda error: m.MotionStatus(), lambda problem: None)
            elif ends == "stop":
                await persist(bus.client(topics.MOTION_STOP), m.StopRequest(owner=PAGE), PERSON_TIMEOUT,
                              lambda error: m.MotionStatus(), lambda problem: None)
            else:
                said = m.TaskCommand(command="pause" if ends == "task pause" else "stop")
                await persist(bus.client(topics.TASK_COMMAND), said, PERSON_TIMEOUT, lambda error: m.TaskStatus(),
                              lambda problem: None)
            for name in victims:
                host.processes[name].kill()
            await asyncio.sleep(float(random.uniform(*LOOKS_ON)))
            if leaves:
                self.made["left so"] += 1
                self.leave()
                return
            await self._start(bus, heard_of)
        finally:
            await bus.close()
            self._network.detach(session)

    async def _start(self, bus: VirtualBus, motion: Reader[m.MotionStatus]) -> None:
        """Start the task as a person does: again, as long as the robot stays stopped."""
        status = bus.reader(self._status)
        while True:
            heard = motion.latest.newest if motion.latest else 0  # who has heard nothing lets go of nothing
            start = m.TaskCommand(command="start", heard=heard)
            await persist(bus.client(topics.TASK_COMMAND), start, PERSON_TIMEOUT, lambda error: m.TaskStatus(),
                          lambda problem: None)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(PERSON_TIMEOUT):
                    while not _started(status.latest, motion.latest):  # noqa: ASYNC110 - time is free here
                        await asyncio.sleep(AGAIN)
            await asyncio.sleep(SURE)
            if _started(status.latest, motion.latest):
                return

    async def _be_person(self, session: VirtualSession, _fault: Fault) -> None:
        """Stop the task; then send the arm home and start the task, from two places that know nothing of each other."""
        session.slow = float(self._random.uniform(0.0, PERSON_SLOW))
        host = self._host
        bus = VirtualBus(session, PERSON, host.cell.name, host.clock, host.requests)
        command, heard_of = bus.client(topics.TASK_COMMAND), bus.reader(topics.MOTION_STATUS)
        motion = OperatorMotion(bus, [bus.reader(self._status)])

        async def go_home() -> None:
            await asyncio.sleep(float(self._random.uniform(0.0, PERSON_LATE)))
            with contextlib.suppress(MotionFailed, RequestFailed):
                await motion.move(m.JointGoal(named="home"))

        try:
            with contextlib.suppress(RequestFailed):
                await command.call(m.TaskCommand(command="stop"), PERSON_TIMEOUT)
            async with asyncio.TaskGroup() as group:
                group.create_task(go_home())
                await asyncio.sleep(float(self._random.uniform(0.0, PERSON_LATE)))
                await self._start(bus, heard_of)
        finally:
            await bus.close()
            self._network.detach(session)


def _started(task: m.TaskStatus | None, motion: m.MotionStatus | None) -> bool:
    """Whether nothing that a person said keeps the task any more."""
    kept = motion is None or any(inhibit.by in (PERSON, PAGE) for inhibit in motion.inhibits)
    return task is not None and task.started and not kept
