"""Makes the faults of a plan happen to a simulated cell; what persons do between lies beside it."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import numpy as np

from common import topics
from common.application import find_application
from common.topics import Topic
from lab.chaos.agent import Chaos
from lab.chaos.plan import Fault as Bad
from lab.chaos.plan import Form
from lab.faults import Amid, Fault, FaultPlan
from lab.loop import Incarnation, context_of
from lab.network import SimulatedSession
from lab.operator_model import OperatorModel
from lab.processes import SimulatedBus, SimulatedHost, SimulatedProcess

AGAIN = 0.1  # [s] between looks whether something has come about
LATEST = 0.3  # [s] after which a process crashes that does not get to the turn at which it was to
NEXT_GOAL = 1.5  # [s] for which the next goal is waited for
TURN = 0.0005  # [s] that stands for a turn where something is to happen just when a goal is asked for
GOALS = (topics.MOTION_EXECUTE.key, topics.GRIPPER_COMMAND.key)
PLAN = topics.MOTION_PLAN.key
STRANGER = "stranger"
FORMS: tuple[Form, ...] = ("truncated", "flipped", "noise", "wrong type")
BAD_MESSAGES = 4  # under one key, at most


class FaultInjector:
    """Lets go wrong in one run what its plan says; `made` counts."""

    def __init__(
        self, host: SimulatedHost, plan: FaultPlan, seed: int, status: Topic[Any], tell: Callable[[str], None]
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
        self.lose_supervisor: Callable[[], Awaitable[object]] = asyncio.Event().wait  # and bring the cell up again
        self._seconds: list[SimulatedProcess] = []
        self._strange = np.random.default_rng([seed, 10])
        self._host, self._plan, self._tell = host, plan, tell
        self._network = host.network
        self.persons = OperatorModel(host, seed, self._strange, status, tell, self.made)

    async def run(self) -> None:
        """Return when all has happened; cancelled, nothing more does."""
        loop, speed = self._host.loop, self._plan.speed
        began, persons = loop.time(), list[asyncio.Task[None]]()
        begins = {"second instance": self._begin_second, "hostile": self._begin_strange,
                  **dict.fromkeys(self.persons.acts, self.persons.begin)}
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

    async def _crash(self, process: SimulatedProcess, fault: Fault) -> bool:
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

    async def _victim(self, fault: Fault) -> tuple[SimulatedProcess, SimulatedSession]:
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

    def _mend(self, session: SimulatedSession) -> None:
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
        second = SimulatedProcess(
            self._host, entry, lambda name, line: self._tell(f"second {name}: {line}"), beside=True)
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
        context = context_of(Incarnation(STRANGER))
        session = self._network.attach(context, STRANGER, self.made["hostile"])
        return context.run(lambda: asyncio.create_task(self._be_strange(session)))

    async def _be_strange(self, session: SimulatedSession) -> None:
        """Put damaged messages and nonsense under every key, and ask for nonsense."""
        host, random = self._host, self._strange
        bus = SimulatedBus(session, STRANGER, host.cell.name, host.clock, host.requests)
        known = {**topics.platform_topics(), **find_application(host.cell.application).topics_by_key}
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
