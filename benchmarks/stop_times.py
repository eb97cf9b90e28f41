"""How soon the arm stops after `task pause` and `task stop`, in whole cells at speed 1.

`python -m benchmarks.stop_times` waits for the arm to move fast, pauses or stops the task and observes the joint
states: the time from just before the request to the stamp of the first state in which no joint moves. It does so again
and again over the motions of a run, and says for each robot how fast the fastest joint was and how long it took.
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from applications.outlining.topics import OUTLINE_STATUS
from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.config import load_cell
from common.messages import JointState, TaskCommand, TaskStatus, WorldEdit
from common.robot.model import RobotModel
from common.transport.bus import Bus, Client, Reader
from tests.harness import RunningCell, folder_for, running_with, until

FAST = 0.6  # share of the fastest that the cell's default scaling allows
SETTLE = 0.3  # [s] between two looks
CELLS = ("panda", "ur5")


@dataclass(frozen=True)
class Stop:
    """One stop: command, speed of the fastest joint before [rad/s], time to rest [ms]."""

    command: str
    speed: float
    milliseconds: float


class Watch:
    """A cell that is stopped again and again."""

    def __init__(self, bus: Bus, cell: str) -> None:
        """Observes the arm and sends commands."""
        self._bus, self._joints = bus, bus.reader(topics.JOINT_STATES)
        self._task: Client[TaskCommand, TaskStatus] = bus.client(topics.TASK_COMMAND)
        self._edit, self._cell = bus.client(topics.WORLD_EDIT), cell
        self._status: Reader[Any] = bus.reader(PICK_PLACE_STATUS if cell == "panda" else OUTLINE_STATUS)
        loaded = load_cell(cell)
        self._names = set(loaded.robot.joints)
        robot = RobotModel.load(loaded.robot)
        self._fast = FAST * float(robot.velocity.min()) * loaded.motion.velocity_scaling

    def _speed(self, state: JointState) -> float:
        return max(abs(v) for name, v in zip(state.name, state.velocity, strict=True) if name in self._names)

    async def _send(self, command: str) -> None:
        await self._task.call(TaskCommand.model_validate({"command": command}), 10.0)

    async def start_again(self) -> None:
        """Whenever the task is done bring back what there was to do, and start it again."""
        async for status in self._status:
            if status.state == "DONE":
                if self._cell == "panda":
                    await self._edit.call(WorldEdit(op="reset"))
                await self._send("start")

    async def stop(self, command: str, again: str, rng: np.random.Generator) -> Stop:
        """Stop the arm in a fast motion, and let it go on."""
        await until(self._joints, lambda s: self._speed(s) > self._fast, 120)
        await asyncio.sleep(float(rng.uniform(0.0, 0.2)))
        state = await self._joints.next()
        while (speed := self._speed(state)) < self._fast:
            state = await self._joints.next()
        begin = self._bus.clock.now_ns()
        asking = asyncio.create_task(self._send(command))
        still = await until(self._joints, lambda s: s.header.stamp > begin and self._speed(s) == 0)
        await asking
        await asyncio.sleep(SETTLE)
        await self._send(again)
        await asyncio.sleep(SETTLE)
        return Stop(command, speed, (still.header.stamp - begin) * 1e-6)


async def stops(cell: RunningCell, count: int, seed: int) -> list[Stop]:
    """So many pauses and as many stops."""
    rng = np.random.default_rng(seed)
    found: list[Stop] = []
    async with cell.listen() as bus:
        watch = Watch(bus, cell.name)
        async with running_with(watch.start_again()):
            for command in [("pause", "resume")] * count + [("stop", "start")] * count:
                found.append(await watch.stop(*command, rng))
    return found


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10, help="pauses and stops of each cell")
    parser.add_argument("--cells", nargs="+", default=CELLS, choices=CELLS)
    arguments = parser.parse_args()
    print("| cell | command | speed before, least to most [rad/s] | to rest, median [ms] | longest [ms] |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as parent:
        for name in arguments.cells:
            with RunningCell(folder_for(Path(parent), name), "up", name, "--no-viewer") as cell:
                done = asyncio.run(stops(cell, arguments.count, 0))
            for command in ("pause", "stop"):
                speeds = [stop.speed for stop in done if stop.command == command]
                times = [stop.milliseconds for stop in done if stop.command == command]
                print(f"| {name} | {command} | {min(speeds):.2f} to {max(speeds):.2f} | {np.median(times):.0f} | "
                      f"{max(times):.0f} |")


if __name__ == "__main__":
    main()
