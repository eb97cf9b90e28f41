"""Which faults happen to a cell, and when: the same seed makes the same plan. Nothing happens here."""

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
CELL_SECONDS = 80.0  # of cell time in which a run sees faults; what comes after is left to it to finish
LEAST_GAP = 0.05  # [s] between two faults
LEFT_STOPPED = 0.25  # share of what is stopped that stays so until a watchdog takes notice
HOLDING = 0.4  # share of the faults of processes that wait for an object in the hand
STATELESS_FORMS: tuple[Form, ...] = ("noise", "wrong type", "huge")  # for which no real message is needed

LABELS: dict[Kind, str] = {
    "kill": "kill -9", "restart": "SIGTERM", "freeze": "SIGSTOP", "delay": "short SIGSTOPs",
    "corrupt": "damaged messages on", "replay": "old messages on", "drop": "what is held slips",
}

_WEIGHTS: dict[Kind, float] = {
    "kill": 6, "restart": 2, "freeze": 4, "delay": 2, "corrupt": 5, "replay": 2, "drop": 3,
}


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        at: when [s, wall time] from the cell being up.
        kind: kill -9, SIGTERM, SIGSTOP for a time, short stops in a row, damaged messages, old messages, an object
            that slips out of the fingers.
        target: name of the process, or key without the cell; empty for an object.
        seconds: how long it lasts, where it lasts; infinite for what stays stopped.
        form: of damaged messages.
        count: messages, or stops in a row.
        seed: of everything else that is random about it.
        holding: whether it waits for an object in the hand.
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
        """How it is done, for people: "2.1 s", "12 truncated"; may be empty."""
        match self.kind:
            case "freeze":
                text = f"{self.seconds:.1f} s" if math.isfinite(self.seconds) else "until it is noticed"
            case "delay":
                text = f"{self.count} x {self.seconds:.2f} s"
            case "corrupt":
                text = f"{self.count} {self.form}"
            case "replay":
                text = f"{self.count}, {self.seconds:.1f} s late"
            case _:
                text = ""
        return ", ".join(part for part in (text, "something in the hand" if self.holding else "") if part)

    @property
    def what(self) -> str:
        """What is done and how: "kill -9", "SIGSTOP: 2.1 s"."""
        return ": ".join(part for part in (LABELS[self.kind], self.detail) if part)

    def __str__(self) -> str:
        """As "SIGSTOP camera_simulator: 2.1 s"."""
        action = f"{LABELS[self.kind]} {self.target}".rstrip()
        return ": ".join(part for part in (action, self.detail) if part)


def faults(
    seed: int, processes: Sequence[str], keys: Sequence[str], *, objects: bool, per_minute: float = PER_MINUTE
) -> Iterator[Fault]:
    """Faults without end, in order.

    Args:
        seed: of the plan.
        processes: that can be killed and stopped.
        keys: of topics and requests under which bad messages are put.
        objects: whether there is something that can slip out of a hand.
        per_minute: of wall time, on average.
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
    """The faults of the first `seconds` [s, wall time]; see `faults`."""
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
