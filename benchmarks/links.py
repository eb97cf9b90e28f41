"""Cuts the link between two hosts of a cell, in the middle of motions and between them: `python -m benchmarks.links`.

Needs root, for network namespaces. Prints a line for each run: its cuts follow each other, and it must still place
all balls.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tests.hosts.cut_cell import SPLITS, CutCell
from tests.hosts.two_hosts import two_hosts, why_not

COUNT = 3  # balls
SECONDS = (1.0, 10.0, 60.0)
CASES = [(split, alone, when) for split in SPLITS for alone in ("finish", "hold") for when in ("motion", "between")
         if split == "robot" or alone == "finish"]  # a task next to the arm is never cut off
MIDDLE = (0.2, 0.8)  # of a motion


def campaign(split: str, alone: str, when: str, speed: float, seconds: list[float], folder: Path) -> dict[str, Any]:
    """What became of one run and its cuts."""
    options = ["--speed", f"{speed:g}", "--set", f"world.count={COUNT}", "--seed", "3",
               "--set", f"services.trajectory_executor.when_alone={alone}"]
    with two_hosts() as two, CutCell(two, folder, split, options) as cell:
        cuts = []
        for length in seconds:
            cell.until(lambda event: event["what"] == "motion" and (
                event["state"] == "succeeded" if when == "between"
                else event["state"] == "active" and MIDDLE[0] < event["progress"] < MIDDLE[1]))
            cuts.append(asdict(cell.cut(length)))
        summary = cell.end(600.0)
        aborted = [event for event in cell.events if event["what"] == "motion" and event["state"] == "aborted"]
        held = any(event["what"] == "motion" and "controller" in event["held"] for event in cell.events)
    return {
        "far": split, "when_alone": alone, "cut": when, "cuts": cuts, "state": summary["state"],
        "placed": summary["placed"], "truth": summary["truth"], "failures": summary["failures"],
        "retries": summary["retries"], "aborted": len(aborted), "held_by_controller": held,
    }


def main() -> int:
    """Run all of them, print a line for each; exit code 0 when every run placed every ball once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--speed", type=float, default=3.0)
    parser.add_argument("--seconds", type=float, nargs="+", default=list(SECONDS), help="lengths of the cuts [s]")
    parser.add_argument("--only", nargs=3, metavar=("SPLIT", "ALONE", "WHEN"), action="append", help="not all cases")
    options = parser.parse_args()
    if reason := why_not():
        sys.exit(reason)
    good = True
    for split, alone, when in options.only or CASES:
        with tempfile.TemporaryDirectory(prefix="zencell-links-") as folder:
            result = campaign(split, alone, when, options.speed, options.seconds, Path(folder))
        sys.stdout.write(json.dumps(result) + "\n")
        sys.stdout.flush()
        good &= result["state"] == "DONE" and result["truth"]["in_box"] == COUNT
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
