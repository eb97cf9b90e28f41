"""Fault plans of simulated cells: which faults happen when. The same seed makes the same plan."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lab.network import GOOD_LINKS, LinkQuality

Kind = Literal[
    "crash", "restart", "cut", "router lost", "stalled", "late goal", "operator", "clock step", "operator stop",
    "speed change", "supervisor lost", "second instance", "malformed messages", "late start", "abandoned goal",
    "takeover",
]
Party = Literal["", "client", "server"]

# Guaranteed and early, so that short runs have them too.
FIRST: tuple[Kind, ...] = ("crash", "crash", "crash", "cut", "stalled", "late goal", "late goal")
LATER: tuple[Kind, ...] = ("crash", "crash", "restart", "cut", "stalled", "late goal", "operator")
LAST: tuple[Kind, ...] = (
    "speed change", "supervisor lost", "second instance", "malformed messages", "late start", "abandoned goal",
    "takeover",
)
FIRST_GAPS = 0.0, 1.5  # [s] of cell time between the first faults
LATER_GAP = 12.0  # [s] of cell time, mean gap between further faults
LONGEST = 60.0  # [s] of cell time after ready with faults; the run then has time to finish
MOST_FAULTS = 20  # per run
MOST_TURNS = 40  # loop turns of a process from the scheduled crash time to the crash
DURING_GOAL_SHARE = 0.6  # of crashes and cuts: while a plan or goal is being requested
DURING_GOAL_TURNS = 12  # loop turns of a process from the request to the crash
CUT_SECONDS = 0.3, 4.0
LATE_SECONDS = 0.3, 3.0  # two links, each delayed by less than its lease
STALL_SECONDS = 0.2, 1.6  # less than Zenoh's lease of 2 s, after which a link is cut
SECOND_SECONDS = 2.0, 6.0  # longest life of a second instance
SLOW_SECONDS = 2.0, 5.0
SECONDS = {"cut": CUT_SECONDS, "stalled": STALL_SECONDS, "late goal": LATE_SECONDS}
STEP_SECONDS = 60.0, 3600.0  # step of the system clock, forward or back
STEP_SOON = 2.0  # [s] of cell time within which the step happens
SKEW = 0.09  # [s] largest clock error of a process; two clocks differ by less than their tolerance of 0.2 s
ROUTER_SHARE = 0.25  # of the cuts after the first
OPERATOR_STOP_SHARE = 0.5  # of the runs: an operator stops or pauses the task, and processes crash then
OPERATOR_STOP_LATEST = 15.0  # [s] of cell time after ready
SPEED_CHANGE_SHARE = 0.25  # of the runs
SUPERVISOR_SHARE = 0.25  # of the runs: the supervisor dies and the cell is started again
SECOND_SHARE = 0.5  # of the runs: a service that is up is started a second time
TOO_LATE_SHARE = 0.25  # of the runs, for each of: late start, abandoned goal, takeover
MOST_MALFORMED = 3  # rounds of malformed messages per run
MEANWHILE = 10.0  # [s] of cell time after ready within which the faults of LAST happen
OPERATOR_SHARE = 0.5  # of the runs: an operator stops the task early
SPEEDS = 0.5, 2.0, 3.0  # cell time per wall time of runs with another speed than 1
OTHER_SPEED = 0.3  # share of those runs


@dataclass(frozen=True)
class Fault:
    """One fault.

    - `crash` ends a process without running `finally`, `restart` sends SIGTERM.
    - `cut` breaks a link, `router lost` breaks all; `stalled` delays a link, `late goal` a goal request or its reply.
    - `clock step` sets the host's system clock.
    - `supervisor lost` ends the supervisor without `finally`, then starts the cell again.
    - `second instance` starts a service that is up; `malformed messages` puts undecodable payloads under all keys.
    - `operator` stops the task, moves the arm and starts the task again. `operator stop` stops or pauses the robot,
      crashes task or executor or both, and may start the task again. `speed change` sets the speed for a while.
      `late start` stops the robot while a start is on its way. `abandoned goal` cancels a motion request before it
      arrives. `takeover` takes motion ownership, jogs the arm and starts the task.

    Attributes:
        at: cell time after the cell is ready [s].
        kind: one of these.
        target: process name; empty for the router, an operator, the supervisor and the system clock.
        during_goal: hit the client or the server of the next plan or goal instead of the target; for `late goal`,
            whether the request (client) or the reply (server) is late.
        turns: loop turns of the process until it crashes.
        seconds: duration of a cut, stall, second instance or low speed; delay of a message; step of the clock [s].
    """

    at: float
    kind: Kind
    target: str = ""
    during_goal: Party = ""
    turns: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class FaultPlan:
    """All faults of one run; `skews` are clock errors by service [s]."""

    faults: tuple[Fault, ...] = ()
    links: LinkQuality = GOOD_LINKS
    skews: tuple[tuple[str, float], ...] = ()
    speed: float = 1.0  # cell time per wall time
    shuffled: bool = False  # whether processes take simultaneous loop turns in random order


def make_plan(seed: int, services: Sequence[str], sooner: float = 1.0, without: Collection[str] = ()) -> FaultPlan:
    """Plan at least three crashes and a cut, reordered, lost and duplicated messages, and wrong clocks.

    Args:
        seed: decides the complete plan.
        services: names of processes that may be hit.
        sooner: factor on the gaps between faults, for cells whose task is shorter than usual.
        without: kinds of `LAST` to leave out; the rest of the plan stays the same.
    """
    random = np.random.default_rng([seed, 5])
    faults = _main_faults(random, services, sooner)
    links = LinkQuality(
        delay=float(random.uniform(0.0002, 0.004)), hiccup=float(random.uniform(0.0002, 0.002)),
        loss=float(random.uniform(0.0, 0.05)), duplicated=float(random.uniform(0.0, 0.02)),
        late=float(random.uniform(0.0, 0.03)),
    )
    skews = tuple((name, float(random.uniform(-SKEW, SKEW))) for name in services)
    speed = float(random.choice(SPEEDS)) if random.random() < OTHER_SPEED else 1.0
    # Each further group of faults draws from its own generator, so that it leaves the others unchanged.
    chance = np.random.default_rng([seed, 7])
    step = float(chance.uniform(*STEP_SECONDS) * chance.choice([-1.0, 1.0]))
    faults.append(Fault(float(chance.uniform(0.0, STEP_SOON)), "clock step", seconds=step))
    stops = np.random.default_rng([seed, 9])
    if stops.random() < OPERATOR_STOP_SHARE:
        faults.append(Fault(float(sooner * stops.uniform(0.0, OPERATOR_STOP_LATEST)), "operator stop"))
    faults += [fault for fault in _last_faults(seed, services, sooner) if fault.kind not in without]
    faults.sort(key=lambda fault: fault.at)
    return FaultPlan(tuple(faults), links, skews, speed, shuffled=True)


def _main_faults(random: np.random.Generator, services: Sequence[str], sooner: float) -> list[Fault]:
    """Return the faults of `FIRST` in random order, then faults of `LATER` until `LONGEST`."""
    first = [*FIRST, *(("operator",) if random.random() < OPERATOR_SHARE else ())]
    kinds: list[Kind] = [first[i] for i in random.permutation(len(first))]
    gaps = [float(gap) for gap in random.uniform(*FIRST_GAPS, len(kinds))]
    while len(kinds) < MOST_FAULTS:
        kinds.append(LATER[int(random.integers(len(LATER)))])
        gaps.append(float(random.exponential(LATER_GAP)))
    faults: list[Fault] = []
    for drawn, gap in zip(kinds, gaps, strict=True):
        kind = drawn
        at = (faults[-1].at if faults else 0.0) + sooner * gap
        if at > sooner * LONGEST:
            break
        if kind == "operator":
            faults.append(Fault(at, kind))
            continue
        target, party, seconds = str(random.choice(list(services))), _requesting_process(random, kind), 0.0
        if kind in SECONDS:
            seconds = float(random.uniform(*SECONDS[kind]))
        if kind == "cut" and any(fault.kind == "cut" for fault in faults) and random.random() < ROUTER_SHARE:
            kind, target = "router lost", ""
        turns = int(random.integers(DURING_GOAL_TURNS if party else MOST_TURNS))
        faults.append(Fault(at, kind, target, party, turns, seconds))
    return faults


def _last_faults(seed: int, services: Sequence[str], sooner: float) -> list[Fault]:
    """Return the faults of `LAST`."""
    random = np.random.default_rng([seed, 11])
    kinds: list[Kind] = ["malformed messages"] * int(random.integers(1, MOST_MALFORMED + 1))
    shares: dict[Kind, float] = {
        "speed change": SPEED_CHANGE_SHARE, "supervisor lost": SUPERVISOR_SHARE, "second instance": SECOND_SHARE,
    }
    kinds += [kind for kind, share in shares.items() if random.random() < share]
    faults = []
    for kind in kinds:
        at, target, seconds = sooner * float(random.uniform(0.0, MEANWHILE)), "", 0.0
        if kind == "speed change":
            seconds = float(random.uniform(*SLOW_SECONDS))
        elif kind == "second instance":
            target, seconds = str(random.choice(list(services))), float(random.uniform(*SECOND_SECONDS))
        faults.append(Fault(at, kind, target, seconds=seconds))
    late = np.random.default_rng([seed, 13])
    too_late: tuple[Kind, ...] = ("late start", "abandoned goal", "takeover")
    for kind in too_late:
        happens, at = late.random() < TOO_LATE_SHARE, sooner * float(late.uniform(0.0, MEANWHILE))
        faults += [Fault(at, kind)] if happens else []
    return faults


def _requesting_process(random: np.random.Generator, kind: Kind) -> Party:
    """Return the process that a fault hits while a goal is being requested; empty if it does not wait for a goal."""
    if kind == "late goal" or (kind in ("crash", "cut") and random.random() < DURING_GOAL_SHARE):
        return "client" if random.random() < 0.5 else "server"
    return ""
