"""Carries out the fault plan of a simulated cell; `operator_model` plays the operators among the faults."""

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
from lab.chaos.plan import Fault as BadMessages
from lab.chaos.plan import Form
from lab.faults import Fault, FaultPlan, Party
from lab.loop import Incarnation, context_of
from lab.network import SimulatedSession
from lab.operator_model import OperatorModel
from lab.processes import SimulatedBus, SimulatedHost, SimulatedProcess

POLL = 0.1  # [s] between checks of a condition
LATEST = 0.3  # [s] after which a process crashes that has not reached the turn of its crash
NEXT_GOAL = 1.5  # [s] to wait for the next goal
TURN = 0.0005  # [s] equivalent of a loop turn where a fault waits for a goal
GOALS = (topics.MOTION_EXECUTE.key, topics.GRIPPER_COMMAND.key)
PLAN = topics.MOTION_PLAN.key
STRANGER = "stranger"
FORMS: tuple[Form, ...] = ("truncated", "flipped", "noise", "wrong type")
BAD_MESSAGES = 4  # most under one key


class FaultInjector:
    """Makes the faults of one plan happen; `injected` counts them by kind."""

    def __init__(
        self, host: SimulatedHost, plan: FaultPlan, seed: int, status: Topic[Any], log: Callable[[str], None]
    ) -> None:
        """Prepare the faults.

        Args:
            host: runs the processes to hit.
            plan: which faults happen when.
            seed: decides what the plan leaves open.
            status: topic of the cell's task.
            log: called with a line for each fault.
        """
        self.injected: Counter[str] = Counter()
        self.lose_supervisor: Callable[[], Awaitable[object]] = asyncio.Event().wait  # and start the cell again
        self._second_instances: list[SimulatedProcess] = []
        self._random = np.random.default_rng([seed, 10])
        self._host, self._plan, self._log = host, plan, log
        self._network = host.network
        self.operators = OperatorModel(host, seed, self._random, status, log, self.injected)

    async def run(self) -> None:
        """Return when all faults have happened; cancel to inject no more."""
        loop, speed = self._host.loop, self._plan.speed
        started_at, running = loop.time(), list[asyncio.Task[None]]()
        concurrent = {"second instance": self._start_second, "malformed messages": self._start_stranger,
                      **dict.fromkeys(self.operators.acts, self.operators.start)}
        try:
            for fault in self._plan.faults:
                await asyncio.sleep(max(0.0, started_at + fault.at / speed - loop.time()))
                if fault.kind in concurrent:
                    self.injected[fault.kind] += 1
                    running.append(concurrent[fault.kind](fault))
                elif fault.kind == "supervisor lost":
                    running.append(asyncio.create_task(self._lose_supervisor()))
                else:
                    await self._inject(fault)
            await asyncio.gather(*running)
        finally:
            for task in running:
                task.cancel()

    def _record(self, fault: Fault, name: str) -> None:
        by = "by" if fault.kind == "clock step" else "for"
        duration = f" {by} {fault.seconds:.1f} s" if fault.seconds else ""
        during = f" during a goal: {fault.during_goal}" if fault.during_goal else ""
        self._log(f"FAULT {fault.kind} {name}{during}{duration}")
        self.injected[fault.kind] += 1

    async def _inject(self, fault: Fault) -> None:
        loop, network = self._host.loop, self._network
        if fault.kind == "clock step":
            self._record(fault, "")
            loop.stepped_ns += round(fault.seconds * 1e9)
            return
        if fault.kind == "late goal":
            if await self._next_goal(fault.during_goal, fault.seconds) is not None:
                self._record(fault, "")
            return
        process, session = await self._victim(fault)
        if fault.kind == "crash":
            while not await self._crash(process, fault):  # the process ended by itself meanwhile
                process, session = await self._victim(replace(fault, during_goal=""))
            return
        if fault.during_goal:
            await asyncio.sleep(fault.turns * TURN)
        self._record(fault, process.name if fault.target else "")
        if fault.kind in ("router lost", "cut"):
            # A second instance admitted while the network was split would drive a second arm: that is no single cell.
            self._kill_second_instances(process.name if fault.kind == "cut" else "")
        if fault.kind == "router lost":
            network.lose_router()
            loop.call_later(fault.seconds, network.restore_router)
        elif fault.kind == "cut":
            network.cut([session])
            loop.call_later(fault.seconds, self._mend, session)
        elif fault.kind == "stalled":
            network.stall(session, fault.seconds)
        else:
            process.terminate()

    async def _crash(self, process: SimulatedProcess, fault: Fault) -> bool:
        """Return whether the process crashed, at its turn or at `LATEST`."""
        incarnation, pid = process.incarnation, process.pid
        process.kill_at_turn(fault.turns)
        deadline = self._host.loop.time() + LATEST
        try:
            while not incarnation.over and self._host.loop.time() < deadline:  # noqa: ASYNC110 - time is free here
                await asyncio.sleep(POLL)
        finally:
            incarnation.at_turn = None
        if not incarnation.over and process.pid == pid:
            process.kill()
        if incarnation.over:
            self._record(fault, process.name)
        return incarnation.over

    async def _victim(self, fault: Fault) -> tuple[SimulatedProcess, SimulatedSession]:
        """Return the process to hit: client or server of the next goal, the target, or another that runs."""
        processes = self._host.processes
        names = [fault.target, *processes]
        if fault.during_goal and (found := await self._next_goal()) is not None:
            client, server = found
            names = [client, server, *names] if fault.during_goal == "client" else [server, client, *names]
        while True:
            for process in [processes[name] for name in names if name in processes]:
                session = process.session
                if session is not None and not (fault.kind == "cut" and session.cut):
                    return process, session
            await asyncio.sleep(POLL)

    async def _next_goal(self, late: Party = "", seconds: float = 0.0) -> tuple[str, str] | None:
        """Return client and server of the next goal or plan request; None if there is none within `NEXT_GOAL`.

        Args:
            late: party whose message is delayed; goals only.
            seconds: the delay [s].
        """
        requests = self._host.requests
        started: asyncio.Future[tuple[str, str]] = asyncio.get_running_loop().create_future()

        def on_start(client: str, server: str, key: str) -> None:
            if (key in GOALS or (key == PLAN and not late)) and not started.done():
                started.set_result((client, server))
                found = [self._host.processes.get(name) for name in (client, server)]
                ends = [session for process in found if process and (session := process.session) is not None]
                if late and len(ends) == 2:
                    source, target = ends if late == "client" else reversed(ends)
                    self._network.delay_next_query(source, target, f"{self._host.cell.name}/{key}", seconds)

        requests.on_start = on_start
        try:
            async with asyncio.timeout(NEXT_GOAL):
                return await started
        except TimeoutError:
            return None
        finally:
            requests.on_start = lambda client, server, key: None

    def _mend(self, session: SimulatedSession) -> None:
        if not session.detached and not self._network.router_lost:
            self._network.mend([session])

    # --- concurrent faults --------------------------------------------------------------------------------------------

    async def _lose_supervisor(self) -> None:
        self._log("FAULT supervisor lost: the cell is started again")
        self.injected["supervisor lost"] += 1
        self._kill_second_instances("")
        await self.lose_supervisor()

    def _start_second(self, fault: Fault) -> asyncio.Task[None]:
        self._log(f"FAULT second instance {fault.target} for {fault.seconds:.1f} s")
        return asyncio.create_task(self._run_second(fault))

    async def _run_second(self, fault: Fault) -> None:
        """Start a service that is up, as a user might by hand, and terminate it unless it ends by itself."""
        entry = next(entry for entry in self._host.cell.services.values() if entry.name == fault.target)
        while (session := self._host.processes[fault.target].session) is None or session.cut:  # noqa: ASYNC110
            await asyncio.sleep(POLL)
        second = SimulatedProcess(
            self._host, entry, lambda name, line: self._log(f"second {name}: {line}"), unsupervised=True)
        self._second_instances.append(second)
        second.start()
        second.release()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(fault.seconds):
                    await second.wait()
        finally:
            second.terminate()
            self._second_instances.remove(second)

    def _kill_second_instances(self, name: str) -> None:
        """Kill the second instances of a service; of all services if the name is empty."""
        for second in self._second_instances:
            if name in ("", second.name):
                second.kill()

    def _start_stranger(self, _fault: Fault) -> asyncio.Task[None]:
        self._log("FAULT malformed messages: under all keys")
        context = context_of(Incarnation(STRANGER))
        session = self._network.attach(context, STRANGER, self.injected["malformed messages"])
        return context.run(lambda: asyncio.create_task(self._run_stranger(session)))

    async def _run_stranger(self, session: SimulatedSession) -> None:
        """Put damaged messages and nonsense under every key, and send nonsense requests."""
        host, random = self._host, self._random
        bus = SimulatedBus(session, STRANGER, host.cell.name, host.clock, host.requests)
        known = {**topics.platform_topics(), **find_application(host.cell.application).topics_by_key}
        keys = [key for key in known if topics.SERVICE not in key]
        bad = [
            BadMessages(0.0, "corrupt", key, form=FORMS[int(random.integers(len(FORMS)))],
                        count=int(random.integers(1, BAD_MESSAGES + 1)), seed=int(random.integers(2**31)))
            for key in [keys[i] for i in random.permutation(len(keys))]
        ]
        try:
            await Chaos(bus, bad, dict, None, known=known).run()
        finally:
            await bus.close()
            self._network.detach(session)
