"""Fault plans for cells of real processes. The same seed makes the same plan; `agent` carries it out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Literal, get_args

import numpy as np

Kind = Literal["kill", "restart", "freeze", "delay", "corrupt", "replay", "drop"]
Form = Literal["", "truncated", "flipped", "noise", "wrong type", "huge"]

PER_MINUTE = 30.0  # faults per minute of wall time
MOST_PER_MINUTE = 600.0
CELL_SECONDS = 80.0  # of cell time with faults in a run; the task then has time to finish
LEAST_GAP = 0.05  # [s] between two faults
LEFT_STOPPED = 0.25  # share of stopped processes that stay so until a watchdog kills them
HOLDING = 0.4  # share of the faults of processes that wait until the gripper holds an object
STATELESS_FORMS: tuple[Form, ...] = ("noise", "wrong type", "huge")  # need no real message

LABELS: dict[Kind, str] = {
    "kill": "kill -9", "restart": "SIGTERM", "freeze": "SIGSTOP", "delay": "short SIGSTOPs",
    "corrupt": "damaged messages on", "replay": "old messages on", "drop": "held object slips",
}

_WEIGHTS: dict[Kind, float] = {
    "kill": 6, "restart": 2, "freeze": 4, "delay": 2, "corrupt": 5, "replay": 2, "drop": 3,
}


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        at: time after the cell is up [s, wall time].
        kind: kill -9, SIGTERM, SIGSTOP for a while, short SIGSTOPs, damaged messages, old messages, or an object
            that slips out of the gripper.
        target: process name, or key without the cell; empty for an object.
        seconds: duration; infinite for a process that stays stopped [s].
        form: of damaged messages.
        count: number of messages or stops.
        seed: decides the rest.
        holding: whether it waits until the gripper holds an object.
    """

    at: float
    kind: Kind
    target: str = ""
    seconds: float = 0.0
    form: Form = ""
    count: int = 1
    seed: int = 0
    holding: bool = False

    @property
    def detail(self) -> str:
        """Parameters as text: "2.1 s", "12 truncated"; may be empty."""
        match self.kind:
            case "freeze":
                text = f"{self.seconds:.1f} s" if math.isfinite(self.seconds) else "until a watchdog acts"
            case "delay":
                text = f"{self.count} x {self.seconds:.2f} s"
            case "corrupt":
                text = f"{self.count} {self.form}"
            case "replay":
                text = f"{self.count}, {self.seconds:.1f} s late"
            case _:
                text = ""
        return ", ".join(part for part in (text, "while holding an object" if self.holding else "") if part)

    @property
    def what(self) -> str:
        """Kind and parameters: "kill -9", "SIGSTOP: 2.1 s"."""
        return ": ".join(part for part in (LABELS[self.kind], self.detail) if part)

    def __str__(self) -> str:
        """Return the fault as "SIGSTOP camera_simulator: 2.1 s"."""
        action = f"{LABELS[self.kind]} {self.target}".rstrip()
        return ": ".join(part for part in (action, self.detail) if part)


def faults(
    seed: int, processes: Sequence[str], keys: Sequence[str], *, objects: bool, per_minute: float = PER_MINUTE
) -> Iterator[Fault]:
    """Yield faults without end, in order of time.

    Args:
        seed: of the plan.
        processes: that may be killed and stopped.
        keys: of topics and requests that may get bad messages.
        objects: whether the gripper holds objects that can slip.
        per_minute: mean number per minute of wall time.
    """
    rng = np.random.default_rng(seed)
    kinds = [kind for kind in get_args(Kind) if objects or kind != "drop"]
    weights = np.array([_WEIGHTS[kind] for kind in kinds])
    mean = max(60.0 / per_minute - LEAST_GAP, 0.01)
    at = 0.0
    while True:
        at += LEAST_GAP + min(float(rng.exponential(mean)), 3 * mean)
        kind: Kind = rng.choice(kinds, p=weights / weights.sum())
        yield _fault(at, kind, rng, processes, keys, objects)


def plan(
    seed: int, processes: Sequence[str], keys: Sequence[str], *, objects: bool, seconds: float,
    per_minute: float = PER_MINUTE,
) -> list[Fault]:
    """Return the faults of the first `seconds` [s, wall time]; see `faults`."""
    endless = faults(seed, processes, keys, objects=objects, per_minute=per_minute)
    return list(takewhile(lambda fault: fault.at <= seconds, endless))


def _fault(
    at: float, kind: Kind, rng: np.random.Generator, processes: Sequence[str], keys: Sequence[str], objects: bool
) -> Fault:
    seed, at = int(rng.integers(2**31)), round(at, 3)
    process, key = str(rng.choice(processes)), str(rng.choice(keys))
    holding = objects and bool(rng.random() < HOLDING)
    if kind in ("kill", "restart"):
        return Fault(at, kind, process, seed=seed, holding=holding)
    if kind == "freeze":
        seconds = math.inf if rng.random() < LEFT_STOPPED else round(float(rng.uniform(0.3, 6.0)), 2)
        return Fault(at, kind, process, seconds, seed=seed, holding=holding)
    if kind == "delay":
        seconds = round(float(rng.uniform(0.05, 0.5)), 2)
        return Fault(at, kind, process, seconds, count=int(rng.integers(2, 6)), seed=seed)
    if kind == "corrupt":
        form: Form = rng.choice([form for form in get_args(Form) if form])
        count = 1 if form == "huge" else int(rng.integers(3, 40))
        return Fault(at, kind, key, form=form, count=count, seed=seed)
    if kind == "replay":
        seconds = round(float(rng.uniform(0.5, 3.0)), 2)
        return Fault(at, kind, key, seconds, count=int(rng.integers(1, 20)), seed=seed)
    return Fault(at, kind, seed=seed)
