"""Things that are put into the way of running motions at random times, in both cells, on the virtual clock.

`python -m benchmarks.obstacles` runs the cells repeatedly with an intruder that puts pillars where the arm
would be 0.4 s to 2 s later, and takes them away after 0.2 s to 2.5 s. It says how near the arm came to them, by coal on
what was executed and their true positions, how long it took from the scene message to the first set-point that
brakes, and how often the motion resumed or was replanned.
"""

from __future__ import annotations

import argparse
import itertools

import numpy as np

from tests.simulated.intruder import Intruder, Intrusion, watched_cell
from tests.simulated.visited import SimulatedCell

CELLS = ("panda", "ur5")
IN_A_RUN = 10


def report(cell: str, found: list[Intrusion], ended: list[str]) -> None:
    """One line of figures."""
    nearest = np.array([one.nearest for one in found])
    latency = 1e3 * np.array([one.latency for one in found])
    given_up, free = sum(one.given_up for one in found), int(np.isnan(latency).sum())
    print(  # noqa: T201
        f"{cell}: {len(found)} times in {len(ended)} runs ({', '.join(sorted(set(ended)))}), {(nearest <= 0).sum()} "
        f"contacts, nearest {1e3 * nearest.min():.1f} mm (median {1e3 * np.median(nearest):.0f} mm); brakes after "
        f"{np.nanmax(latency):.1f} ms at most (median {np.nanmedian(latency):.1f} ms); {len(found) - given_up} went "
        f"on, {given_up} were replanned; {free} were not held: the task was first, or they passed by", flush=True)


def main() -> None:
    """Run and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=50, help="of each cell")
    parser.add_argument("--cells", nargs="+", default=CELLS, choices=CELLS)
    parser.add_argument("--seed", type=int, default=1, help="of the first run")
    asked = parser.parse_args()
    for cell in asked.cells:
        found: list[Intrusion] = []
        ended: list[str] = []
        for seed in itertools.count(asked.seed):
            intruder = Intruder(seed, min(IN_A_RUN, asked.times - len(found)))
            run = SimulatedCell(watched_cell(cell), seed=seed, visit=intruder.visit)
            found += intruder.found
            ended.append(run.outcome.state)
            report(cell, found, ended)
            if len(found) >= asked.times:
                break


if __name__ == "__main__":
    main()
