"""The tasks of several arms as one: its state ends when all have ended, and its counters are sums."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from common.messages import TaskStatus

S = TypeVar("S", bound=TaskStatus)
ENDED = ("DONE", "ERROR")
SUMS = ("done", "total", "failures", "retries", "moving_seconds", "planning_seconds")
LISTS = ("skipped", "plans")


def combined(kind: type[S], statuses: Mapping[str, TaskStatus], arms: int) -> S:
    """Return the status of all tasks.

    Args:
        kind: its class.
        statuses: newest status of each arm's task.
        arms: number of arms; with fewer statuses nothing has ended.
    """
    each = list(statuses.values())
    values: dict[str, Any] = {name: sum(getattr(one, name) for one in each) for name in SUMS}
    values |= {name: [item for one in each for item in getattr(one, name)] for name in LISTS}
    open_ = [one for one in each if one.state not in ENDED]
    if open_ or len(each) < arms:
        state = open_[0].state if open_ else "IDLE"
    else:
        state = "ERROR" if any(one.state == "ERROR" for one in each) else "DONE"
    messages = [f"{arm}: {one.message}" for arm, one in statuses.items() if one.message]
    values |= {
        "state": state, "message": "; ".join(messages), "paused": bool(each) and any(one.paused for one in each),
        "started": any(one.started for one in each),
        "stage": "; ".join(f"{arm}: {one.stage}" for arm, one in statuses.items() if one.stage),
        "subject": "; ".join(f"{arm}: {one.subject}" for arm, one in statuses.items() if one.subject),
        "task_seconds": max((one.task_seconds for one in each), default=0.0),
        "overlooked": "; ".join(one.overlooked for one in each if one.overlooked),
        "figures": {f"{arm}.{name}": value for arm, one in statuses.items() for name, value in one.figures.items()},
    }
    return kind.model_validate(values)
