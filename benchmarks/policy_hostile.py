"""Hostile policies in a cell on the virtual clock: contacts, and the largest share of each limit.

    python -m benchmarks.policy_hostile hostile.jsonl --sequences 10000

Late, stalled, repeated, broken, jumping and adversarial chunks, while an operator holds the arm, changes its speed and
takes control. The lab's invariants check every set-point, coal checks every millisecond of the motion. The file has a
line for each cell of 25 sequences; a later call continues it.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from tests.applications.policy.hostile_cell import run_hostile

EACH = 25  # sequences of a cell


def total(lines: list[dict[str, object]]) -> str:
    """Return the sums and maxima of verdicts."""
    counted = Counter[str]()
    most: dict[str, float] = {}
    for line in lines:
        counted.update({name: line[name] for name in ("sequences", "checked", "contacts", "moving")})
        counted.update(line["chunks"])
        counted["broken"] += len(line["broken"]) + len(line["crashes"])
        for name, share in line["most"].items():
            most[name] = max(most.get(name, 0.0), share)
    shares = ", ".join(f"{name} {share:.3f}" for name, share in most.items())
    c = counted
    return (f"{c['sequences']} sequences in {len(lines)} cells, {c['chunks']} chunks: {c['proved']} proved "
            f"({c['slowed']} slowed), {c['shortened']} shortened, {c['refused']} refused, {c['late']} late, "
            f"{c['failed']} failed; {c['moving']:.0f} s of motion, {c['checked']} positions: {c['contacts']} contacts, "
            f"{c['broken']} invariants broken or crashes; largest shares of the limits: {shares}")


def main() -> None:
    """Run until there are so many sequences in the file; print the totals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=1000, help="first seed")
    given = parser.parse_args()
    lines = [json.loads(line) for line in given.out.read_text().splitlines()] if given.out.exists() else []
    seed = given.first + len(lines)
    while sum(line["sequences"] for line in lines) < given.sequences:
        verdict = {"seed": seed, **asdict(run_hostile(seed, EACH))}
        lines.append(verdict)
        with given.out.open("a") as file:
            file.write(json.dumps(verdict) + "\n")
        if verdict["contacts"] or verdict["broken"] or verdict["crashes"]:
            print(f"seed {seed}: {verdict}", flush=True)
        seed += 1
        if len(lines) % 20 == 0:
            print(total(lines), flush=True)
    print(total(lines))


if __name__ == "__main__":
    main()
