"""Grasps of unseen objects by the complete sorting cell: arm, planner, camera with noise, calibration error, physics.

`python -m benchmarks.grasping --singles 300 --force 20` puts one object of a kind that training never saw into the tray
for each seed; only the first try counts, and it counts if the object came to rest in a container. `--heaps 30` clears
heaps of 10. `--latency 10` measures the processor time from an image to proved grasps, and plans motions to the first
ten. Every seed draws objects, mass (50 to 500 g), friction (0.2 to 0.6) and an error of the camera's pose of 3 mm and
3 degrees.

Results are appended to a file, one line a run; seeds that are in it are not run again. A run that crashes or does not
end is a failure with its reason. Needs the extra `physics`.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from benchmarks.grasping_run import CELL, Case, Mode, run

Row = dict[str, Any]
HEAP = 10  # objects
WALL_LIMIT = 3600.0  # [s] of one run
Z95 = 1.96  # of a normal distribution, two-sided 95 %
MARK = "RESULT "  # before the line of a result
KEY = ("mode", "seed", "force", "count", "meshes", "cell", "sets")


def wilson(good: int, of: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson, JASA 22, 1927)."""
    if of == 0:
        return 0.0, 1.0
    p, z2 = good / of, Z95**2
    middle, half = p + z2 / (2 * of), Z95 * math.sqrt(p * (1 - p) / of + z2 / (4 * of**2))
    return (middle - half) / (1 + z2 / of), (middle + half) / (1 + z2 / of)


def share(good: int, of: int) -> str:
    """Return a share with its interval, as "27 of 30, 90.0 % (74.4 to 96.5)"."""
    low, high = wilson(good, of)
    return f"{good} of {of}, {100 * good / max(of, 1):.1f} % ({100 * low:.1f} to {100 * high:.1f})"


# --- runs -------------------------------------------------------------------------------------------------------------


def key_of(row: Row) -> str:
    """Return what distinguishes the run of a row or of a case as a dictionary."""
    return json.dumps([list(row[name]) if name == "sets" else row[name] for name in KEY])


def run_apart(case: Case) -> Row:
    """Run a case in a process of its own, which may crash."""
    command = [sys.executable, "-m", "benchmarks.grasping", "--one", json.dumps(asdict(case))]
    try:
        ran = subprocess.run(command, capture_output=True, text=True, timeout=WALL_LIMIT, check=False)
    except subprocess.TimeoutExpired:
        return failed(case, "timeout", f"{WALL_LIMIT:g} s of wall time")
    for line in ran.stdout.splitlines():
        if line.startswith(MARK):
            result: Row = json.loads(line.removeprefix(MARK))
            return result
    last = (ran.stderr.strip() or f"exit code {ran.returncode}").splitlines()[-1]
    return failed(case, "crash", last)


def failed(case: Case, first: str, message: str) -> Row:
    """Return the row of a run without a result."""
    return {**asdict(case), "first": first, "attempts": [], "ended_in": {}, "wanted": {}, "state": "", "left": [],
            "message": message, "seconds": 0.0, "latencies": [], "planned": [], "crashes": [message]}


def run_all(cases: Sequence[Case], file: Path, jobs: int) -> list[Row]:
    """Run the cases that the file lacks; return the rows of all."""
    known = {}
    if file.exists():
        for text in file.read_text(encoding="utf-8").splitlines():
            row = json.loads(text)
            known[key_of(row)] = row
    missing, lock = [case for case in cases if key_of(asdict(case)) not in known], Lock()
    print(f"{len(cases)} runs, {len(cases) - len(missing)} of them in {file}", flush=True)

    def one(case: Case) -> None:
        row = run_apart(case)
        with lock:
            known[key_of(row)] = row
            with file.open("a", encoding="utf-8") as out:
                out.write(json.dumps(row) + "\n")
            print(describe(row), flush=True)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(one, missing))
    return [known[key_of(asdict(case))] for case in cases]


def describe(row: Row) -> str:
    """Return a run in a line."""
    result = f"{row['first'] or 'held'}" if row["mode"] == "single" else f"{len(sorted_right(row))} of {row['count']}"
    why = f"  {row['message']}" if row["message"] else ""
    return (f"  {row['mode']} {row['seed']:>3}  {result:<16} {len(row['attempts'])} tries  {row['seconds']:6.1f} s  "
            f"{row['state']}{why}")


# --- tables -----------------------------------------------------------------------------------------------------------


def sorted_right(row: Row) -> list[str]:
    """Return the objects that ended in the container that the rule names for their true color."""
    return [name for name, place in row["ended_in"].items() if place == row["wanted"].get(name)]


def failures(reasons: Iterable[str]) -> str:
    """Return how often each reason occurred."""
    counted = Counter(reason for reason in reasons if reason)
    return ", ".join(f"{count} {reason}" for reason, count in counted.most_common()) or "none"


def singles_table(rows: list[Row]) -> list[str]:
    """Return the figures of single objects."""
    wrong = [row for row in rows if not row["first"] and not sorted_right(row)]
    kinds: dict[str, list[Row]] = {}
    for row in rows:
        kinds.setdefault(next(iter(row["ended_in"]), "unknown").rpartition("_")[0] or "unknown", []).append(row)
    return [
        f"single unseen objects, first try, {rows[0]['force']:g} N: held "
        f"{share(sum(not row['first'] for row in rows), len(rows))}",
        f"  failures: {failures(row['first'] for row in rows)}; held, but in the wrong container: {len(wrong)}",
        "  " + ", ".join(f"{kind} {sum(not row['first'] for row in those)} of {len(those)}"
                         for kind, those in sorted(kinds.items())),
    ]


def heaps_table(rows: list[Row]) -> list[str]:
    """Return the figures of heaps."""
    objects = sum(row["count"] for row in rows)
    attempts = [attempt for row in rows for attempt in row["attempts"]]
    right = sum(len(sorted_right(row)) for row in rows)
    placed = sum(place in set(row["wanted"].values()) for row in rows for place in row["ended_in"].values())
    several = [a for a in attempts if len(a["lifted"]) > 1]
    seconds = sum(row["seconds"] for row in rows)
    unseen = sum(a["noticed"] != "two" for a in several)
    return [
        f"heaps of {rows[0]['count']}, {rows[0]['force']:g} N: removed and sorted right {share(right, objects)}",
        f"  removed into any container: {share(placed, objects)}; in the wrong one: {placed - right}",
        f"  tries that brought something into a container: "
        f"{share(sum(not a['failure'] for a in attempts), len(attempts))}",
        f"  failed tries: {failures(a['failure'] for a in attempts)}",
        f"  two at once: {len(several)}, unnoticed {unseen}",
        f"  {3600 * placed / max(seconds, 1e-9):.0f} objects an hour of cell time; ended "
        f"{failures(row['state'] or row['first'] for row in rows)}",
    ]


def latency_table(rows: list[Row]) -> list[str]:
    """Return the figures of perception and planning."""
    times = 1e3 * np.array([value for row in rows for value in row["latencies"]])
    plans = [error for row in rows for error in row["planned"]]
    lines = ["from the image to proved grasps: no image"]
    if len(times):
        lines = [f"from the image to proved grasps: {np.median(times):.0f} ms in the median, "
                 f"{np.percentile(times, 95):.0f} ms at 95 %, processor time ({len(times)} images, {len(rows)} heaps)"]
    return [*lines, f"motions to the first candidates: {share(sum(not e for e in plans), len(plans))}; errors: "
                    f"{failures(plans)}"]


TABLES: dict[Mode, Callable[[list[Row]], list[str]]] = {
    "single": singles_table, "heap": heaps_table, "latency": latency_table}


# --- command ----------------------------------------------------------------------------------------------------------


def cases_of(options: argparse.Namespace) -> list[Case]:
    """Return the runs that were asked for."""
    first = int(options.seeds.partition("-")[0])
    wanted: list[tuple[Mode, int, int]] = [
        ("single", options.singles, 1), ("heap", options.heaps, HEAP), ("latency", options.latency, HEAP)]
    if not any(number for _, number, _ in wanted):
        wanted = [("single", 10, 1), ("heap", 2, HEAP), ("latency", 2, HEAP)]
    if options.seeds.partition("-")[2]:
        number = int(options.seeds.partition("-")[2]) - first + 1
        wanted = [(mode, min(some, number), count) for mode, some, count in wanted]
    return [Case(mode, seed, options.force, count, options.meshes, options.cell, tuple(options.set))
            for mode, number, count in wanted for seed in range(first, first + number)]


def main() -> None:
    """Run, and print all figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--singles", type=int, default=0, metavar="N", help="runs with a single object")
    parser.add_argument("--heaps", type=int, default=0, metavar="N", help=f"runs with {HEAP} objects")
    parser.add_argument("--latency", type=int, default=0, metavar="N", help="heaps that are looked at")
    parser.add_argument("--seeds", default="1", metavar="A-B", help="first seed, or a range that limits the runs")
    parser.add_argument("--force", type=float, default=20.0, help="of each finger [N]")
    parser.add_argument("--meshes", default="", metavar="FOLDER", help="objects from files in place of drawn ones")
    parser.add_argument("--cell", default=CELL)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="as of zencell run")
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time")
    parser.add_argument("--json", type=Path, default=Path("grasping.jsonl"), metavar="FILE", help="one line a run")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        given = json.loads(options.one)
        print(MARK + json.dumps(run(Case(**{**given, "sets": tuple(given["sets"])}))))
        return
    cases = cases_of(options)
    rows = run_all(cases, options.json, options.jobs)
    for mode, table in TABLES.items():
        if those := [row for row in rows if row["mode"] == mode]:
            print("\n" + "\n".join(table(those)))


if __name__ == "__main__":
    main()
