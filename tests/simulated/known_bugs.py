"""Known bugs, each put back into the fixed code, and the number of seeds until a simulation finds it.

`python -m tests.simulated.known_bugs [MOST]` prints the table.
"""

import asyncio
import contextlib
import sys
from unittest.mock import patch

from applications.pick_place.perceived_scene import PerceivedScene
from common import topics
from common.config import load_cell
from common.control import request_handlers
from common.control.goals import GoalMemory
from common.control.interlocks import InterlockFile, Record
from common.control.limiter import Limiter
from common.control.motion_authority import MotionOwnership
from common.control.trajectory_controller import TrajectoryController
from common.time_source import host_ns, wall_ns
from common.transport import requests
from common.transport.reader import SequenceFilter
from lab import processes
from lab.doubles import settings_of, with_doubles
from lab.simulation import Simulation
from services import smart_pick_place, trajectory_executor

CELL = ("panda", ["world.count=1"])  # the faults come early: a short run sees as many of them
RARE = ("a new goal while another runs",)  # one seed in thirty


def _truth_read():
    honest = smart_pick_place.run

    async def run(bus, config):
        bus.reader(topics.SCENE_OBJECTS)
        await honest(bus, config)

    return patch.object(smart_pick_place, "run", run)


def _hold_forgotten():
    honest = TrajectoryController.hold

    def hold(self, *arguments, **named):
        honest(self, *arguments, **named)
        self.reports.holds.clear()
        return self.status

    return patch.object(TrajectoryController, "hold", hold)


def _hold_without_brakes():
    """And without the last stage, which would brake."""
    def step(self, target, velocity, *_, **__):
        self.position = target
        return target, velocity

    brakes = contextlib.ExitStack()
    brakes.enter_context(patch("common.hardware.pace.next_rate", lambda path, time, pace, target, *_: target))
    brakes.enter_context(patch.object(Limiter, "step", step))
    return brakes


@contextlib.contextmanager
def _two_goals():
    """Neither whose the motion is nor what runs keeps a goal from beginning: each of the two would do."""
    honest = TrajectoryController.accept

    def accept(self, goal, *arguments, **named):
        if self.reports.memory.get(goal) is None:
            self._goal = None
        return honest(self, goal, *arguments, **named)

    with patch.object(TrajectoryController, "accept", accept), patch.object(MotionOwnership, "check", lambda *_: None):
        yield


def _clock_of_its_own():
    honest = processes.SkewedClock.__init__

    def begin(self, like, skew_ns):
        honest(self, like, skew_ns)
        self._offset_ns = wall_ns() - host_ns()

    return patch.object(processes.SkewedClock, "__init__", begin)


def _waits_without_end():
    async def send(self, payload, seconds, timeout):
        future = self._loop.create_future()

        def settle(reply):
            self._loop.call_soon_threadsafe(requests._settle, future, reply)

        self._session.get(self._key, settle, lambda: None, payload=payload, timeout=1e9)
        return await future

    return patch.object(requests.Client, "_send", send)


def _never_asked_again():
    async def once(client, request, timeout, refused, note, again=()):
        try:
            return await client.call(request, timeout=timeout)
        except Exception as error:
            note(str(error))
            await asyncio.Event().wait()

    return patch("common.process.task_requests.call_until_answered", once)


BUGS = {
    "what is not newer is read": lambda: patch.object(SequenceFilter, "is_new", lambda self, attachment: True),
    "a repeated goal id acts again": lambda: patch.object(GoalMemory, "get", lambda self, goal: None),
    "the task reads the truth": _truth_read,
    "a hold is forgotten": _hold_forgotten,
    "a hold without brakes": _hold_without_brakes,
    "a motion that was decided long ago begins": lambda: patch.object(
        request_handlers, "check_age", lambda *_: None),
    "objects and arm forgotten at a restart": lambda: patch.object(
        trajectory_executor, "state_file", lambda cell: None),
    "a stop dies with the executor": lambda: patch.object(InterlockFile, "load", lambda self: (Record(), "")),
    "a new goal while another runs": _two_goals,
    "a request that waits without end": _waits_without_end,
    "a request that is not asked again": _never_asked_again,
    "what is in the hand is forgotten": lambda: patch.object(
        PerceivedScene, "feel", lambda self, state, T_world_tcp: None),
    "what day it is asked for at each start": _clock_of_its_own,
    "goal ids that repeat after a restart": lambda: patch("common.process.task_runner.new_id", lambda: "0000"),
}


def cell_with(bug):
    """The cell in which a bug is looked for: with doubles where only many runs see it."""
    if bug not in RARE:
        return load_cell(*CELL)
    application = load_cell(CELL[0]).application
    return with_doubles(load_cell(CELL[0], settings_of(application)))


def found_within(bug, most):
    """Return the number of seeds until the bug is found, and its report; None if it is not."""
    cell = cell_with(bug)
    for seed in range(1, most + 1):
        with BUGS[bug]():
            outcome = Simulation(cell, seed, faults=True, limit=120.0).run()
        assert not any("TypeError" in crash for crash in outcome.crashes), f"it was put back wrongly: {outcome.crashes}"
        if not outcome.ok or outcome.crashes:
            return seed, "; ".join([f"{outcome.state} {outcome.message}", *outcome.crashes[:1]])
    return None


if __name__ == "__main__":
    most = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    for name in sys.argv[2:] or BUGS:
        with contextlib.suppress(BrokenPipeError):
            sys.stdout.write(f"{name}: {found_within(name, most)}\n")
            sys.stdout.flush()
