"""What goes wrong in a simulated cell, and when: the same seed makes the same plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from common.virtual.network import FAIR, Weather

Kind = Literal["crash", "restart", "cut", "router lost"]

CRASHES: tuple[Kind, ...] = ("crash", "crash", "crash")  # at least, and soon: short runs see them all too
FIRST_GAPS = 0.2, 2.5  # [s] between those
LATER_GAP = 12.0  # [s] on average to each further fault
LONGEST = 60.0  # [s] from the cell being ready; what comes after is left to it to finish
MOST_FAULTS = 20  # of one run
MOST_TURNS = 40  # of a process, from the time at which it is to crash to where it does
CUT_SECONDS = 0.3, 3.0
SKEW = 0.09  # [s] by which clocks are wrong at most; two of them differ by less than their tolerance of 0.2 s
ROUTER_SHARE = 0.25  # of the cuts


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        at: when [s] from the cell being ready.
        kind: an end without `finally`; SIGTERM; a link that is cut; all links that are cut.
        target: name of the process; empty for the router.
        turns: of the process from then on until it crashes.
        seconds: for which a link is cut.
    """

    at: float
    kind: Kind
    target: str = ""
    turns: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Plan:
    """All that goes wrong in one run; clocks by service [s]."""

    faults: tuple[Fault, ...] = ()
    weather: Weather = FAIR
    skews: tuple[tuple[str, float], ...] = ()


def make_plan(seed: int, services: Sequence[str]) -> Plan:
    """At least three crashes and a cut, messages that change places, are lost and doubled, and clocks that are wrong.

    Args:
        seed: decides all of it.
        services: names of those that may be hit.
    """
    random = np.random.default_rng([seed, 5])
    first: list[Kind] = [*CRASHES, "cut"]
    later: tuple[Kind, ...] = ("crash", "crash", "restart", "cut")
    kinds = [first[i] for i in random.permutation(len(first))]
    gaps = [float(gap) for gap in random.uniform(*FIRST_GAPS, len(kinds))]
    while len(kinds) < MOST_FAULTS:
        kinds.append(later[int(random.integers(len(later)))])
        gaps.append(float(random.exponential(LATER_GAP)))
    faults: list[Fault] = []
    for kind, gap in zip(kinds, gaps, strict=True):
        at = (faults[-1].at if faults else 0.0) + gap
        if at > LONGEST:
            break
        target, seconds = str(random.choice(list(services))), 0.0
        if kind == "cut":
            seconds = float(random.uniform(*CUT_SECONDS))
            if random.random() < ROUTER_SHARE:
                faults.append(Fault(at, "router lost", seconds=seconds))
                continue
        faults.append(Fault(at, kind, target, int(random.integers(MOST_TURNS)), seconds))
    weather = Weather(
        delay=float(random.uniform(0.0002, 0.004)), hiccup=float(random.uniform(0.0002, 0.002)),
        loss=float(random.uniform(0.0, 0.05)), doubled=float(random.uniform(0.0, 0.02)),
    )
    skews = tuple((name, float(random.uniform(-SKEW, SKEW))) for name in services)
    return Plan(tuple(faults), weather, skews)
