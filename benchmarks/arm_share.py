"""The arm's own share of a run, by what was recorded of it: `python -m benchmarks.arm_share [RECORDING.mcap]`.

Sums the durations of executed motions of arm and fingers on `motion/status` and `gripper/state`, with nothing of the
cell's own figures. Without a recording it simulates the Panda cell at full speed and at a fifth of it. The way that the
arm took is checked at 0.005 rad with the convex hulls of the links, against table, box, itself and the balls where they
really were.
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

from applications.pick_place.contact_check import ContactCheck, RecordedMotion
from common.application import find_application
from common.config import load_cell
from common.transport.codec import decode
from recording.report.aggregator import RunAggregator

ENDS = ("succeeded", "aborted", "cancelled")
KINDS = {"motion/status": "arm", "gripper/state": "fingers"}
SCALINGS = (0.2, 1.0)
CELL = "panda"
STEP = 0.005  # [rad]


def spans(recording: Path) -> dict[str, list[tuple[float, float]]]:
    """When each goal that was executed began and ended [s], by who executed it."""
    started: dict[tuple[str, str], float] = {}
    found: dict[str, list[tuple[float, float]]] = {kind: [] for kind in KINDS.values()}
    with recording.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            kind = KINDS.get(channel.topic.partition("/")[2])
            if kind is None:
                continue
            said: dict[str, Any] = msgpack.unpackb(message.data)
            goal, stamp = (kind, said["id"]), said["header"]["stamp"] * 1e-9
            if said["id"] and said["state"] == "active":
                started.setdefault(goal, stamp)
            elif said["state"] in ENDS and goal in started:
                found[kind].append((started.pop(goal), stamp))
    return found


def report(recording: Path) -> str:
    """A line about a recording."""
    found = spans(recording)
    arm, fingers = (sum(end - begin for begin, end in found[kind]) for kind in ("arm", "fingers"))
    times = [time for goals in found.values() for goal in goals for time in goal]
    whole = max(times) - min(times) if times else 0.0
    return (f"arm {arm:.2f} s in {len(found['arm'])} motions, fingers {fingers:.2f} s, from the first to the last "
            f"{whole:.2f} s: the arm moves {arm / whole if whole else 0:.0%} of it")


def checked(recording: Path) -> str:
    """What the arm touched, in words."""
    cell, motion = load_cell(CELL), RecordedMotion()
    aggregator = RunAggregator(CELL, find_application(cell.application), listeners=motion.listeners())
    topics = {topic.key: topic for topic in motion.listeners()}
    with recording.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            key = channel.topic.partition("/")[2]
            if key in topics:
                aggregator.on(key, decode(topics[key].message, message.data), 0.0, 0)
    recheck = ContactCheck(cell, STEP)
    contacts = recheck.contacts(motion)
    return "; ".join([f"{len(contacts)} contacts in {recheck.checked:,} positions", *map(str, contacts)])


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--seed", default="1")
    given = parser.parse_args()
    if given.recording is not None:
        print(report(given.recording))
        return
    with tempfile.TemporaryDirectory() as folder:
        for scaling in SCALINGS:
            file = Path(folder) / f"{scaling}.mcap"
            scalings = [f"motion.{kind}_scaling={scaling}" for kind in ("velocity", "acceleration")]
            subprocess.run(
                [sys.executable, "-m", "cli.main", "simulate", CELL, "--seed", given.seed, "--trace", str(file),
                 "--set", scalings[0], "--set", scalings[1]], check=True, stdout=subprocess.DEVNULL)
            print(f"scaling {scaling}: {report(file)}; {checked(file)}")


if __name__ == "__main__":
    main()
