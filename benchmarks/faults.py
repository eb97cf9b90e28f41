"""Kills processes of running cells at random moments, also while a ball is held, and looks how the runs end.

`python -m benchmarks.faults --runs 3` makes three runs for the router and for each service but the page.
In each of them the process gets a kill -9 twice: at any moment, and with a ball in the hand.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.config import load_cell
from common.messages import SupervisorStatus
from common.transport.bus import Bus
from tests.harness import RunningCell, folder_for, running_with, until

CELL = "panda"
SPARED = "viewer"  # nothing depends on it
TIMEOUT = 240.0  # [s] for one run
ANY_MOMENT = 8.0  # [s] after the first motion, at most
WHILE_HOLDING = 0.8  # [s] after a ball was taken, at most; it is held for about one second at speed 5


@dataclass
class Outcome:
    """What became of the runs in which one process was killed."""

    victim: str
    balls: int
    states: list[str] = field(default_factory=list)
    in_box: list[int] = field(default_factory=list)
    restarts: int = 0
    seconds_lost: list[float] = field(default_factory=list)  # wall time

    def add(self, summary: dict[str, Any], lost: float) -> None:
        """Add a run and its additional wall time [s]."""
        self.states.append(summary["state"])
        self.in_box.append((summary["truth"] or {}).get("in_box", 0))
        self.restarts += summary["restarts"].get(self.victim, 0)
        self.seconds_lost.append(lost)

    @property
    def good(self) -> bool:
        """Whether every run ended DONE with every ball in the box."""
        return all(state == "DONE" for state in self.states) and all(n == self.balls for n in self.in_box)


@dataclass
class Assassin:
    """Kills one process of a cell twice."""

    cell: RunningCell
    victim: str
    rng: random.Random
    notes: list[str] = field(default_factory=list)  # when that was

    async def run(self, bus: Bus) -> None:
        """Kill the process at a random moment, and again while a ball is held."""
        gripper, task = bus.reader(topics.GRIPPER_STATE), bus.reader(PICK_PLACE_STATUS)
        processes = bus.reader(topics.SUPERVISOR_STATUS)
        await until(bus.reader(topics.MOTION_STATUS), lambda status: status.state == "active")
        for number in range(2):
            if number == 0:
                await asyncio.sleep(self.rng.uniform(0, ANY_MOMENT))
            else:
                await until(gripper, lambda state: not state.holding)
                await until(gripper, lambda state: state.holding)
                await asyncio.sleep(self.rng.uniform(0, WHILE_HOLDING))
            await until(processes, self._is_ready)
            held = gripper.latest is not None and gripper.latest.holding
            stage = task.latest.stage if task.latest is not None else ""
            self.cell.processes()[self.victim].kill()
            self.notes.append(f"{stage or 'between stages'} ({'holding' if held else 'empty'})")

    def _is_ready(self, status: SupervisorStatus) -> bool:
        said = any(service.name == self.victim and service.state == "ready" for service in status.services)
        return said and self.victim in self.cell.processes()  # its end may not be known yet


@dataclass(frozen=True)
class Ended:
    """One run: its summary, its exit code, and what there is to say about it."""

    summary: dict[str, Any]
    code: int
    notes: list[str]


async def run_once(victim: str, rng: random.Random, folder: Path, speed: float) -> Ended:
    """A run in which a process is killed; none, when it has no name."""
    with RunningCell(folder, "run", CELL, "--speed", f"{speed:g}") as cell:
        assassin = Assassin(cell, victim, rng)
        async with cell.listen() as bus, running_with(*([assassin.run(bus)] if victim else [])):
            try:
                code = await cell.ended(TIMEOUT)
            except TimeoutError as error:
                assassin.notes.append(str(error))
                cell.interrupt()
                code = await cell.ended(10.0)
        if left := cell.processes():
            assassin.notes.append(f"left behind: {', '.join(left)}")
        return Ended(cell.summary, code, assassin.notes)


async def run_all(options: argparse.Namespace, folder: Path) -> int:
    """Kill each in turn; 0 when every run ended as it should."""
    rng = random.Random(options.seed)
    cell = load_cell(CELL)
    wanted = cell.world.count
    victims = options.services or ["router", *(name for name in cell.services if name != SPARED)]
    plain = (await run_once("", rng, folder_for(folder, "undisturbed"), options.speed)).summary
    undisturbed = plain["seconds"]["task"] / options.speed
    print(f"undisturbed: {plain['state']}, {plain['truth']['in_box']} balls in the box, {undisturbed:.1f} s wall time")
    outcomes = []
    for victim in victims:
        outcome = Outcome(victim, wanted)
        outcomes.append(outcome)
        for number in range(options.runs):
            run = await run_once(victim, rng, folder_for(folder, f"{victim} {number + 1}"), options.speed)
            figures = run.summary
            outcome.add(figures, figures["seconds"]["task"] / options.speed - undisturbed)
            print(f"{victim} {number + 1}: exit code {run.code}, {figures['state']}, {outcome.in_box[-1]} of {wanted} "
                  f"in the box, {outcome.seconds_lost[-1]:+.1f} s, failures {figures['failures']}, retries "
                  f"{figures['retries']}; killed during {', '.join(run.notes)}", flush=True)
    print(table(outcomes))
    return 0 if all(outcome.good for outcome in outcomes) else 1


def table(outcomes: list[Outcome]) -> str:
    """All outcomes, a line for each process."""
    lines = ["", "| killed | runs | DONE | balls in the box | started again | seconds lost: median | most |",
             "|---|---|---|---|---|---|---|"]
    for o in outcomes:
        lines.append(f"| {o.victim} | {len(o.states)} | {o.states.count('DONE')} | {sum(o.in_box)} of "
                     f"{o.balls * len(o.states)} | {o.restarts} x | {median(o.seconds_lost):.1f} | "
                     f"{max(o.seconds_lost):.1f} |")
    return "\n".join(lines)


def main() -> int:
    """Read the options and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("services", nargs="*", help="router or services to kill; all but viewer")
    parser.add_argument("--runs", type=int, default=2, help="for each of them")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--speed", type=float, default=5.0, help="cell time per wall time")
    parser.add_argument("--folder", help="where logs and summaries go")
    options = parser.parse_args()
    folder = Path(options.folder or tempfile.mkdtemp(prefix="zencell-faults-"))
    print(f"logs and summaries are in {folder}")
    return asyncio.run(run_all(options, folder))


if __name__ == "__main__":
    raise SystemExit(main())
