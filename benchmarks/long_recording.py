"""Memory of a recorder over hours of cell time, and of the export: `python -m benchmarks.long_recording RUN.mcap`.

Writes the messages of a recording again and again, with later times and sequence numbers, until the cell time is over,
as fast as the disk allows; chunks end as the recorder ends them. Then prints the memory of this process every ten
minutes of cell time, and what a reader of the file needs.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import psutil

from recording.capture import FLUSH_SECONDS
from recording.reader import Recording
from recording.writer import RecordingWriter

SHOW_EVERY = 600  # [s] of cell time
MB = 1e6


def memory() -> float:
    """Return the resident memory of this process [MB]."""
    return float(psutil.Process().memory_info().rss) / MB


def main() -> None:
    """Write, measure, read."""
    parser = argparse.ArgumentParser()
    parser.add_argument("recording", type=Path)
    parser.add_argument("--hours", type=float, default=2.0, help="of cell time")
    parser.add_argument("--folder", type=Path, help="for the file, which is deleted [temporary]")
    given = parser.parse_args()
    with Recording(given.recording) as recording:
        samples = list(recording.samples())
    first, last = samples[0].log_time, samples[-1].log_time
    period = last - first + 10_000_000
    rounds = round(given.hours * 3600 / (period * 1e-9))
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        file, began, cpu = Path(folder) / "long.mcap", time.monotonic(), time.process_time()
        writer, flush_at, show_at = RecordingWriter(file, {"cell": "long"}), 0, SHOW_EVERY
        print(f"{len(samples):,} messages in {period * 1e-9:.1f} s, {rounds} times; memory before {memory():.0f} MB")
        for number in range(rounds):
            for sample in samples:
                now = sample.log_time + number * period
                writer.add(replace(sample, log_time=now, publish_time=0,
                                   sequence=sample.sequence + number * len(samples)))
                if now >= flush_at:
                    writer.flush()
                    flush_at = now + round(FLUSH_SECONDS * 1e9)
            if (number + 1) * period * 1e-9 >= show_at:
                print(f"{show_at / 60:.0f} min: {memory():.0f} MB, file {writer.size / MB:.0f} MB, "
                      f"{time.monotonic() - began:.0f} s", flush=True)
                show_at += SHOW_EVERY
        writer.close({"reason": "benchmark"})
        print(f"closed: {memory():.0f} MB, {writer.messages:,} messages, {time.process_time() - cpu:.0f} s of "
              "processor time")
        before = memory()
        with Recording(file) as recording:
            topic, count = "joint_states", 0
            for _ in recording.samples(lambda each: each == topic):
                count += 1
        print(f"read {count:,} messages of {topic}: {memory() - before:.0f} MB more")


if __name__ == "__main__":
    main()
