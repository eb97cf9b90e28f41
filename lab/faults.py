"""What goes wrong in a simulated cell, and when: the same seed makes the same plan."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lab.network import GOOD_LINKS, LinkQuality

Kind = Literal[
    "crash", "restart", "cut", "router lost", "stalled", "late goal", "person", "clock step", "ended", "slowed",
    "supervisor lost", "second instance", "hostile", "stopped again", "gave up", "taken over",
]
Amid = Literal["", "asker", "asked"]

# At least, and soon: in short runs as well.
FIRST: tuple[Kind, ...] = ("crash", "crash", "crash", "cut", "stalled", "late goal", "late goal")
LATER: tuple[Kind, ...] = ("crash", "crash", "restart", "cut", "stalled", "late goal", "person")
LAST: tuple[Kind, ...] = (
    "slowed", "supervisor lost", "second instance", "hostile", "stopped again", "gave up", "taken over")
FIRST_GAPS = 0.0, 1.5  # [s] of cell time between those
LATER_GAP = 12.0  # [s] of cell time on average to each further fault
LONGEST = 60.0  # [s] of cell time from the cell being ready; what comes after is left to it to finish
MOST_FAULTS = 20  # of one run
MOST_TURNS = 40  # of a process, from the time at which it is to crash to where it does
AMID_SHARE = 0.6  # of crashes and cuts: just when a plan or a goal is asked for
AMID_TURNS = 12  # of a process, from a goal being asked for to where it crashes
CUT_SECONDS = 0.3, 4.0
LATE_SECONDS = 0.3, 3.0  # two links, each of which holds something up for less than its lease
STALL_SECONDS = 0.2, 1.6  # less than Zenoh's lease of 2 s, after which a link is cut
SECOND_SECONDS = 2.0, 6.0  # for which a second instance is there at most
SLOW_SECONDS = 2.0, 5.0
SECONDS = {"cut": CUT_SECONDS, "stalled": STALL_SECONDS, "late goal": LATE_SECONDS}
STEP_SECONDS = 60.0, 3600.0  # by which somebody sets the system clock, forth or back
STEP_SOON = 2.0  # [s] of cell time in which it happens
SKEW = 0.09  # [s] by which clocks are wrong at most; two of them differ by less than their tolerance of 0.2 s
ROUTER_SHARE = 0.25  # of the cuts but for the first
ENDED_SHARE = 0.5  # of the runs: somebody stops or pauses the task, and processes die then
ENDED_LATEST = 15.0  # [s] of cell time from the cell being ready
SLOWED_SHARE = 0.25  # of the runs: somebody sets the speed
SUPERVISOR_SHARE = 0.25  # of the runs: the supervisor dies, and the cell is brought up again
SECOND_SHARE = 0.5  # of the runs: somebody starts a service that is up
TOO_LATE_SHARE = 0.25  # of the runs: a start comes later than a stop; and of the runs: a goal later than its end; and
# of the runs: somebody takes the motion over
MOST_HOSTILE = 3  # of a run
MEANWHILE = 10.0  # [s] of cell time from the cell being ready, in which these happen
PERSON_SHARE = 0.5  # of the runs: somebody stops the task early on
SPEEDS = 0.5, 2.0, 3.0  # cell time per wall time of those runs that have another than 1
OTHER_SPEED = 0.3  # share of those


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        at: when [s] of cell time from the cell being ready.
        kind: an end without `finally`; SIGTERM; a link that is cut; all links that are cut; a link on which everything
            comes late; a goal that is asked for, or the answer, comes late; a person who stops the task, moves the
            arm and starts the task again; the system clock of the host is set; a person who stops or pauses it, upon
            which task or executor or both crash, and who starts it later or leaves it so; a person who sets the speed;
            the supervisor ends without `finally`, and somebody brings the cell up again; somebody starts a service
            that is up; payloads that nobody can read under all keys; a person who starts the task, and another who
            stops the robot while that is on its way; a person who asks for a motion and gives up before that is heard;
            a person who takes the motion over from whoever has it, jogs the arm, and starts the task.
        target: name of the process; empty for the router, for a person, the supervisor and the system clock.
        amid: it hits who next asks for a plan or a goal of arm or fingers, or who is asked for it, instead of the
            target; of a late goal it is the request, or the answer.
        turns: of the process from then on until it crashes.
        seconds: for which a link is cut or stalled, a second instance is there or the speed is low, or by which
            something is late or the clock is set.
    """

    at: float
    kind: Kind
    target: str = ""
    amid: Amid = ""
    turns: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class FaultPlan:
    """All that goes wrong in one run, and what is left to chance; clocks by service [s]."""

    faults: tuple[Fault, ...] = ()
    weather: LinkQuality = GOOD_LINKS
    skews: tuple[tuple[str, float], ...] = ()
    speed: float = 1.0  # cell time per wall time
    shuffled: bool = False  # the processes take the turns that are due at once in any order


def make_plan(seed: int, services: Sequence[str], sooner: float = 1.0, without: Collection[str] = ()) -> FaultPlan:
    """At least three crashes and a cut, messages that change places, are lost and doubled, and clocks that are wrong.

    Args:
        seed: decides all of it.
        services: names of those that may be hit.
        sooner: share of the usual time between faults, in a cell whose task takes less time than usual.
        without: of `LAST`, which do not happen; the rest of the plan is the same.
    """
    random = np.random.default_rng([seed, 5])
    first = [*FIRST, *(("person",) if random.random() < PERSON_SHARE else ())]
    kinds: list[Kind] = [first[i] for i in random.permutation(len(first))]
    gaps = [float(gap) for gap in random.uniform(*FIRST_GAPS, len(kinds))]
    while len(kinds) < MOST_FAULTS:
        kinds.append(LATER[int(random.integers(len(LATER)))])
        gaps.append(float(random.exponential(LATER_GAP)))
    faults: list[Fault] = []
    for chosen, gap in zip(kinds, gaps, strict=True):
        kind = chosen
        at = (faults[-1].at if faults else 0.0) + sooner * gap
        if at > sooner * LONGEST:
            break
        if kind == "person":
            faults.append(Fault(at, kind))
            continue
        target, amid, seconds = str(random.choice(list(services))), _amid(random, kind), 0.0
        if kind in SECONDS:
            seconds = float(random.uniform(*SECONDS[kind]))
        if kind == "cut" and any(fault.kind == "cut" for fault in faults) and random.random() < ROUTER_SHARE:
            kind, target = "router lost", ""
        turns = int(random.integers(AMID_TURNS if amid else MOST_TURNS))
        faults.append(Fault(at, kind, target, amid, turns, seconds))
    weather = LinkQuality(
        delay=float(random.uniform(0.0002, 0.004)), hiccup=float(random.uniform(0.0002, 0.002)),
        loss=float(random.uniform(0.0, 0.05)), doubled=float(random.uniform(0.0, 0.02)),
        late=float(random.uniform(0.0, 0.03)),
    )
    skews = tuple((name, float(random.uniform(-SKEW, SKEW))) for name in services)
    speed = float(random.choice(SPEEDS)) if random.random() < OTHER_SPEED else 1.0
    chance = np.random.default_rng([seed, 7])
    step = float(chance.uniform(*STEP_SECONDS) * chance.choice([-1.0, 1.0]))
    faults.append(Fault(float(chance.uniform(0.0, STEP_SOON)), "clock step", seconds=step))
    ends = np.random.default_rng([seed, 9])  # of its own, so that it leaves the other faults as they are
    if ends.random() < ENDED_SHARE:
        faults.append(Fault(float(sooner * ends.uniform(0.0, ENDED_LATEST)), "ended"))
    faults += [fault for fault in _strange(seed, services, sooner) if fault.kind not in without]
    faults.sort(key=lambda fault: fault.at)
    return FaultPlan(tuple(faults), weather, skews, speed, shuffled=True)


def _strange(seed: int, services: Sequence[str], sooner: float) -> list[Fault]:
    """What else persons and strangers do; from a generator of its own, which leaves the other faults as they are."""
    random = np.random.default_rng([seed, 11])
    kinds: list[Kind] = ["hostile"] * int(random.integers(1, MOST_HOSTILE + 1))
    shares: dict[Kind, float] = {
        "slowed": SLOWED_SHARE, "supervisor lost": SUPERVISOR_SHARE, "second instance": SECOND_SHARE,
    }
    kinds += [kind for kind, share in shares.items() if random.random() < share]
    faults = []
    for kind in kinds:
        at, target, seconds = sooner * float(random.uniform(0.0, MEANWHILE)), "", 0.0
        if kind == "slowed":
            seconds = float(random.uniform(*SLOW_SECONDS))
        elif kind == "second instance":
            target, seconds = str(random.choice(list(services))), float(random.uniform(*SECOND_SECONDS))
        faults.append(Fault(at, kind, target, seconds=seconds))
    late = np.random.default_rng([seed, 13])
    too_late: tuple[Kind, ...] = ("stopped again", "gave up", "taken over")
    for kind in too_late:
        happens, at = late.random() < TOO_LATE_SHARE, sooner * float(late.uniform(0.0, MEANWHILE))
        faults += [Fault(at, kind)] if happens else []
    return faults


def _amid(random: np.random.Generator, kind: Kind) -> Amid:
    """Whether and whom a fault hits when a goal is asked for."""
    if kind == "late goal" or (kind in ("crash", "cut") and random.random() < AMID_SHARE):
        return "asker" if random.random() < 0.5 else "asked"
    return ""
