"""Cells with several arms: the keys that each arm has for itself, below its name.

In a cell with `robots: {left: ..., right: ...}` the key `motion/status` of an arm is `left/motion/status`. All other
keys, such as those of cameras, I/O and the simulated world, are shared.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from common.remapping import ARM_KEYS, Remapping

if TYPE_CHECKING:
    from common.topics import Request, Topic

T = TypeVar("T", bound="Topic[Any] | Request[Any, Any]")


def arm_table(arm: str, more: Iterable[str] = ()) -> dict[str, str]:
    """Return the remapping table of an arm's services: its keys, and `more` of them, below its name."""
    return {key: f"{arm}/{key}" for key in (*ARM_KEYS, *more)}


def of_arm(topic: T, arm: str) -> T:
    """Return a topic or request under the key that an arm has for it; unchanged if all arms share the key."""
    return arms_topic(topic, arm) if arm and Remapping(arm_table(arm)).key(topic.key) != topic.key else topic


def arms_topic(topic: T, arm: str) -> T:
    """Return a topic or request below the name of an arm."""
    return replace(topic, key=f"{arm}/{topic.key}")


def arm_of(key: str, arms: Iterable[str]) -> str:
    """Return the arm below whose name a key of the cell is; empty for a key that all share."""
    first, below, _ = key.partition("/")
    return first if below and first in arms else ""
