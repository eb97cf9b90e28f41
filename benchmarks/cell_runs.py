"""Whole runs of the Panda cell: what ended in the box by the truth, and whether the arm touched anything.

`python -m benchmarks.cell_runs --seeds 1-20` runs a random layout of seven balls for each seed, and two blocks of five
balls that stand close together. The way that the arm took is recorded and checked again at 0.01 rad, with the convex
hulls of the links, against table, box, itself and the balls where they really were.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from applications.pick_place.contact_check import Contact, ContactCheck, RecordedMotion
from common.application import find_application
from common.config import load_cell
from common.transport.bus import Bus
from common.transport.codec import decode
from recording.report.aggregator import RunAggregator
from tests.harness import RunningCell, folder_for, running_with

CELL = "panda"
TIMEOUT = 180.0  # [s] for one run
BLOCKS = {  # five balls each
    "cross 67 mm": [[0.50, -0.15], [0.567, -0.15], [0.433, -0.15], [0.50, -0.083], [0.50, -0.217]],
    "2 x 3 - 1, 65 mm": [[0.45, -0.20], [0.515, -0.20], [0.45, -0.135], [0.515, -0.135], [0.45, -0.07]],
}


@dataclass
class Result:
    """One run."""

    label: str
    balls: int
    exit_code: int
    summary: dict[str, Any]
    contacts: list[Contact]
    positions: int
    largest_step: float

    @property
    def in_box(self) -> int:
        """Balls in the box by the truth."""
        return int((self.summary.get("truth") or {}).get("in_box", 0))

    @property
    def good(self) -> bool:
        """Whether all went as it should."""
        return self.exit_code == 0 and self.in_box == self.balls and not self.contacts


async def record(bus: Bus, stop: asyncio.Event) -> RecordedMotion:
    """What is said about arm, hand and truth until `stop` is set; it is decoded when there is time for that."""
    recording = RecordedMotion()
    aggregator = RunAggregator(bus.cell, find_application(load_cell(CELL).application), listeners=recording.listeners())
    raw: list[tuple[str, bytes]] = []
    topics_by_key = {topic.key: topic for topic in aggregator.topics}

    async def keep(key: str) -> None:
        async for sample in bus.raw_reader(f"{bus.cell}/{key}"):
            raw.append((key, sample.payload))

    async with running_with(*(keep(topic.key) for topic in recording.listeners())):
        await stop.wait()
    for key, payload in raw:
        aggregator.on(key, decode(topics_by_key[key].message, payload), 0.0, 0)
    return recording


async def run_once(label: str, balls: int, speed: float, options: list[str], folder: Path) -> Result:
    """Run the cell, record the way of the arm, check it."""
    stop = asyncio.Event()
    with RunningCell(folder, "run", CELL, "--speed", f"{speed:g}", *options) as cell:
        async with cell.listen() as bus:
            recording = asyncio.create_task(record(bus, stop))
            code = await cell.ended(TIMEOUT)
            stop.set()
            recorded = await recording
        summary = cell.summary
    recheck = ContactCheck(load_cell(CELL))
    contacts = await asyncio.to_thread(recheck.contacts, recorded)
    steps = [max(abs(a - b) for a, b in zip(p.position[:7], q.position[:7], strict=True))
             for p, q in zip(recorded.joints, recorded.joints[1:], strict=False)]
    return Result(label, balls, code, summary, contacts, recheck.checked, max(steps, default=0.0))


def describe(result: Result) -> str:
    """One run in a line, with what was left and what touched below."""
    s = result.summary
    planners = Counter(plan["planner"] for plan in s["plans"])
    line = (
        f"{result.label:<18} {s['state']:<5} {result.in_box}/{result.balls}  retries {s['retries']}  failures "
        f"{s['failures']}  task {s['seconds']['task']:6.1f} s  "
        + " ".join(f"{name} {count}" for name, count in sorted(planners.items()))
        + f"  contacts {len(result.contacts)}  ({result.positions} positions, steps to {result.largest_step:.3f} rad)"
    )
    left = [f"    left at {place['position']}: {place['reason']}" for place in s["rejected"]]
    return "\n".join([line, *left, *(f"    contact: {contact}" for contact in result.contacts)])


def totals(results: list[Result]) -> str:
    """All runs together."""
    planners = Counter(plan["planner"] for r in results for plan in r.summary["plans"])
    plans = [plan["seconds"] * 1e3 for r in results for plan in r.summary["plans"]]
    pairs = Counter(" - ".join(contact.pair) for r in results for contact in r.contacts)
    ball_count = sum(r.balls for r in results)
    retries, failures = (sum(r.summary[name] for r in results) for name in ("retries", "failures"))
    return "\n".join([
        f"\n{len(results)} runs: {sum(r.in_box for r in results)} of {ball_count} balls in the box, "
        f"{sum(r.summary['state'] == 'DONE' for r in results)} DONE, retries {retries}, failures {failures}, "
        f"left {sum(len(r.summary['rejected']) for r in results)}",
        f"task {median(r.summary['seconds']['task'] for r in results):.1f} s of cell time in the median, "
        f"{median(r.summary['seconds']['task'] / r.balls for r in results):.2f} s a ball",
        f"plans {len(plans)}, {median(plans):.1f} ms in the median, "
        f"{sorted(plans)[int(0.95 * (len(plans) - 1))]:.1f} ms at 95 %; "
        + ", ".join(f"{name} {count / len(plans):.1%}" for name, count in planners.most_common()),
        f"contacts {sum(pairs.values())} in {sum(r.positions for r in results)} positions"
        + "".join(f"\n    {count} x {pair}" for pair, count in pairs.most_common()),
    ])


def jobs_of(options: argparse.Namespace) -> list[tuple[str, int, list[str]]]:
    """What was asked for: label, number of balls and options of zencell of each run."""
    first, _, last = options.seeds.partition("-")
    seeds = range(int(first), int(last or first) + 1) if options.seeds else range(0)
    extra = [part for text in options.set for part in ("--set", text)]
    jobs: list[tuple[str, int, list[str]]] = [
        (f"seed {seed}", options.count, [
            "--seed", str(seed), "--set", "world.layout=random", "--set", f"world.count={options.count}", *extra])
        for seed in seeds
    ]
    if options.blocks:
        jobs += [(name, len(balls), ["--set", f"world.balls={json.dumps(balls)}", *extra])
                 for name, balls in BLOCKS.items()]
    return jobs


async def run_all(options: argparse.Namespace, folder: Path) -> int:
    """Run what was asked for; 0 when all went as it should."""
    free = asyncio.Semaphore(options.jobs)

    async def one(label: str, balls: int, arguments: list[str]) -> Result:
        async with free:
            result = await run_once(label, balls, options.speed, arguments, folder_for(folder, label))
        print(describe(result), flush=True)
        return result

    results = await asyncio.gather(*(one(*job) for job in jobs_of(options)))
    print(totals(results))
    return 0 if all(result.good for result in results) else 1


def main() -> int:
    """Read the options and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cell_runs", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", default="1-20", metavar="A-B", help="random layouts; empty for none")
    parser.add_argument("--count", type=int, default=7, help="balls of a random layout")
    parser.add_argument("--speed", type=float, default=5.0, help="cell time per wall time")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="as of zencell run")
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time")
    parser.add_argument("--folder", help="where logs and summaries go")
    parser.add_argument("--no-blocks", dest="blocks", action="store_false", help="without the blocks of five")
    options = parser.parse_args()
    folder = Path(options.folder or tempfile.mkdtemp(prefix="zencell-runs-"))
    print(f"logs and summaries are in {folder}")
    return asyncio.run(run_all(options, folder))


if __name__ == "__main__":
    raise SystemExit(main())
