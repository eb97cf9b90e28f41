"""The arm's own share of a run, by what was recorded of it: `python -m benchmarks.arm_share [RECORDING.mcap]`.

Sums the durations of executed motions of arm and fingers on `motion/status` and `gripper/state`, with nothing of the
cell's own figures. Without a recording it simulates the Panda cell at full speed and at a fifth of it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import msgpack
from mcap.reader import make_reader

ENDS = ("succeeded", "aborted", "cancelled")
KINDS = {"motion/status": "arm", "gripper/state": "fingers"}
SCALINGS = (0.2, 1.0)


def spans(recording: Path) -> dict[str, list[tuple[float, float]]]:
    """When each goal that was executed began and ended [s], by who executed it."""
    begun: dict[tuple[str, str], float] = {}
    found: dict[str, list[tuple[float, float]]] = {kind: [] for kind in KINDS.values()}
    with recording.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            kind = KINDS.get(channel.topic.partition("/")[2])
            if kind is None:
                continue
            said: dict[str, Any] = msgpack.unpackb(message.data)
            goal, stamp = (kind, said["id"]), said["header"]["stamp"] * 1e-9
            if said["id"] and said["state"] == "active":
                begun.setdefault(goal, stamp)
            elif said["state"] in ENDS and goal in begun:
                found[kind].append((begun.pop(goal), stamp))
    return found


def told(recording: Path) -> str:
    """A line about a recording."""
    found = spans(recording)
    arm, fingers = (sum(end - begin for begin, end in found[kind]) for kind in ("arm", "fingers"))
    times = [time for goals in found.values() for goal in goals for time in goal]
    whole = max(times) - min(times) if times else 0.0
    return (f"arm {arm:.2f} s in {len(found['arm'])} motions, fingers {fingers:.2f} s, from the first to the last "
            f"{whole:.2f} s: the arm moves {arm / whole if whole else 0:.0%} of it")


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--seed", default="1")
    given = parser.parse_args()
    if given.recording is not None:
        print(told(given.recording))
        return
    with tempfile.TemporaryDirectory() as folder:
        for scaling in SCALINGS:
            file = Path(folder) / f"{scaling}.mcap"
            scalings = [f"motion.{kind}_scaling={scaling}" for kind in ("velocity", "acceleration")]
            subprocess.run(
                [sys.executable, "-m", "cli.main", "simulate", "panda", "--seed", given.seed, "--trace", str(file),
                 "--set", scalings[0], "--set", scalings[1]], check=True, stdout=subprocess.DEVNULL)
            print(f"scaling {scaling}: {told(file)}")


if __name__ == "__main__":
    main()
