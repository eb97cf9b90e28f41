"""Runs of a cell under faults on purpose: each has to end DONE with every ball in the box and nothing left.

`python -m benchmarks.chaos` makes fifty runs of the Panda at speed 5, from seed 1 on; with `--cell ur5` an object
is outlined in each, and has to be as a whole, within a millimetre. What became of each run is a line in a JSON lines
file: seeds that are in there are not run again.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import tempfile
import time
from collections import Counter
from pathlib import Path
from statistics import median
from typing import Any

from lab.chaos.plan import LABELS
from tests.harness import LOG, SUMMARY, RunningCell, folder_for

USUAL = "panda"
WORLD = {USUAL: [], "ur5": ["--world", "w2"]}
ASKED = ("cell", "speed", "balls", "rate", "set")  # what makes a run with a seed the same as another
BEFORE: dict[str, Any] = {"cell": USUAL, "set": []}  # of runs in a file without these fields
MOST_OFF = 1.0  # [mm] from the true outline
TIMEOUT = 300.0  # [s] for one run
RECORDING = "run.mcap"


async def run_once(seed: int, folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """What became of the run with the faults of a seed; its log and recording stay in the folder if it was not good."""
    began = time.monotonic()
    arguments = ["--speed", f"{options.speed:g}", "--chaos", str(seed), *WORLD[options.cell]]
    if options.cell == USUAL:
        arguments += ["--set", f"world.count={options.balls}"]
    if options.rate:
        arguments += ["--chaos-rate", f"{options.rate:g}"]
    for setting in options.set:
        arguments += ["--set", setting]
    if options.record:
        arguments += ["--record", str(folder / RECORDING)]
    outcome: dict[str, Any] = {"seed": seed, **{name: getattr(options, name) for name in ASKED}}
    with RunningCell(folder, "run", options.cell, *arguments) as cell:
        try:
            outcome["code"] = await cell.ended(TIMEOUT)
        except TimeoutError:
            outcome["late"] = True
            cell.interrupt()
            try:
                outcome["code"] = await cell.ended(20.0)
            except TimeoutError:
                outcome["code"] = None
        outcome["left_behind"] = sorted(cell.processes())
        outcome["summary"] = cell.summary if (folder / SUMMARY).exists() else None
    outcome["seconds"] = round(time.monotonic() - began, 1)
    outcome["problems"] = problems(outcome)
    if not outcome["problems"]:
        (folder / LOG).unlink()
        (folder / RECORDING).unlink(missing_ok=True)
    return outcome


def problems(outcome: dict[str, Any]) -> list[str]:
    """What is wrong with a run; nothing when it is good."""
    found = [f"{name} was left behind" for name in outcome["left_behind"]]
    if outcome.get("late"):
        found.append(f"did not end within {TIMEOUT:g} s")
    summary = outcome["summary"]
    if summary is None:
        return [*found, "no summary"]
    if summary["state"] != "DONE" or outcome["code"] != 0:
        found.append(f"ended {summary['state']} with exit code {outcome['code']}")
    if (outline := summary.get("outline")) is not None:
        off = outline["deviation_mm"]
        if not (outline["fraction"] == 1 and off and off["max"] < MOST_OFF):
            found.append(f"{outline['fraction']:.1%} outlined, off by {off} mm")
        return found
    truth = summary["truth"] or {"in_box": 0, "on_table": 0, "elsewhere": 0}
    if [truth[place] for place in ("in_box", "on_table", "elsewhere")] != [outcome["balls"], 0, 0]:
        found.append(f"{truth['in_box']} of {outcome['balls']} in the box, {truth['on_table']} on the table, "
                     f"{truth['elsewhere']} elsewhere")
    return found


def table(outcomes: list[dict[str, Any]]) -> str:
    """All runs together."""
    summaries = [outcome["summary"] for outcome in outcomes if outcome["summary"]]
    happened = Counter(fault["what"].partition(":")[0] for summary in summaries for fault in summary.get("chaos", []))
    in_box = sum((summary["truth"] or {}).get("in_box", 0) for summary in summaries)
    good = sum(not outcome["problems"] for outcome in outcomes)
    lines = ["", "| fault | times |", "|---|---|"]
    lines += [f"| {label.removesuffix(' on')} | {happened[label]} |" for label in LABELS.values()]
    lines += [
        "", f"| runs | {len(outcomes)} |", "|---|---|",
        f"| DONE as a whole, no process left | {good} |",
        f"| balls in the box | {in_box} of {sum(o['balls'] for o in outcomes if o.get('cell', USUAL) == USUAL)} |",
        f"| faults in a run, median (least to most) | {_spread([len(s.get('chaos', [])) for s in summaries])} |",
        f"| processes started again | {sum(sum(s['restarts'].values()) for s in summaries)} |",
        f"| failures and retries of the task | {sum(s['failures'] + s['retries'] for s in summaries)} |",
        f"| wall time of a run [s], median (least to most) | {_spread([o['seconds'] for o in outcomes])} |",
    ]
    return "\n".join(lines)


def _spread(values: list[float]) -> str:
    return f"{median(values):g} ({min(values):g} to {max(values):g})" if values else "-"


def earlier(file: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Runs that were made before with the same options, one for each seed: the newest."""
    if not file.exists():
        return []
    found = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    asked = {name: getattr(options, name) for name in ASKED}
    same = [one for one in found if all(one.get(name, BEFORE.get(name)) == value for name, value in asked.items())]
    return list({one["seed"]: one for one in same}.values())


async def run_all(options: argparse.Namespace, file: Path, folder: Path) -> int:
    """Make the runs that are still to be made; 0 when all are good."""
    seeds = range(options.seed, options.seed + options.runs)
    outcomes = [one for one in earlier(file, options) if one["seed"] in seeds]
    if options.again:
        outcomes = [one for one in outcomes if not one["problems"]]
    left = [seed for seed in seeds if seed not in {one["seed"] for one in outcomes}]
    free = asyncio.Semaphore(options.parallel)

    async def one(seed: int) -> None:
        async with free:
            outcome = await run_once(seed, folder_for(folder, f"seed {seed} {time.time_ns()}"), options)
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(outcome) + "\n")
        outcomes.append(outcome)
        faults = len((outcome["summary"] or {}).get("chaos", []))
        print(f"seed {seed}: {'; '.join(outcome['problems']) or 'good'}, {faults} faults, {outcome['seconds']:.0f} s",
              flush=True)

    async with asyncio.TaskGroup() as group:
        for seed in left:
            group.create_task(one(seed))
    print(table(outcomes))
    for outcome in outcomes:
        for problem in outcome["problems"]:
            print(f"seed {outcome['seed']}: {problem}")
    return 1 if any(outcome["problems"] for outcome in outcomes) else 0


def main() -> int:
    """Read the options and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.chaos", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--cell", choices=WORLD, default=USUAL)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1, help="of the first run")
    parser.add_argument("--parallel", type=int, default=1, help="runs at the same time")
    parser.add_argument("--speed", type=float, default=5.0, help="cell time per wall time")
    parser.add_argument("--balls", type=int, default=7)
    parser.add_argument("--rate", type=float, help="faults per minute of wall time")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="as for `zencell run`")
    parser.add_argument("--record", action="store_true", help="record each run, and keep that of a bad one")
    parser.add_argument("--file", help="JSON lines of what became of the runs; runs that are in there are not repeated")
    parser.add_argument("--again", action="store_true", help="repeat those that were not good")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="zencell-chaos-"))
    file = Path(options.file) if options.file else folder / "chaos.jsonl"
    print(f"runs are listed in {file}, logs of bad ones are in {folder}", flush=True)
    return asyncio.run(run_all(options, file, folder))


if __name__ == "__main__":
    raise SystemExit(main())
