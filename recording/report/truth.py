"""Where everything really was, for the evaluation of a run only."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from common.messages import PoseArray, WorldObjects

SAME = 0.05  # [m] from where something is to where it was seen: less well where the picture cuts it off
BOX = "box"  # the container of recordings that do not tell its id


@dataclass(frozen=True)
class Thing:
    """An object: its centre [m] in world, what becomes of it, and the container in which it lies."""

    position: tuple[float, float, float]
    state: str
    container: str = ""


@dataclass
class Truth:
    """Where everything is, as it was said last."""

    containers: tuple[str, ...] = ()  # of the cell, as far as they are known
    _objects: list[Thing] | None = None
    _labelled: list[Thing] | None = None

    def on_objects(self, message: WorldObjects) -> None:
        """Take note of all objects; in old recordings they do not tell what becomes of them."""
        if all("state" in thing.model_fields_set for thing in message.objects):
            self._objects = [
                Thing((thing.pose.position.x, thing.pose.position.y, thing.pose.position.z), thing.state,
                      thing.container)
                for thing in message.objects
            ]

    def on_labels(self, message: PoseArray) -> None:
        """Take note of what is told as poses with labels."""
        labels = message.labels or [""] * len(message.poses)
        self._labelled = [
            Thing((pose.position.x, pose.position.y, pose.position.z), "contained" if label == BOX else label,
                  BOX if label == BOX else "")
            for pose, label in zip(message.poses, labels, strict=False)
        ]

    @property
    def things(self) -> list[Thing] | None:
        """Everything that there is; None when nobody said anything, as with real hardware."""
        if self._objects or self._labelled is None:
            return self._objects
        return self._labelled

    @property
    def settled(self) -> bool:
        """Whether nothing is on its way any more."""
        return not any(thing.state in ("falling", "held") for thing in self.things or ())

    def left(self, named: Sequence[Sequence[float]]) -> list[Thing]:
        """What lies in no container and at none of the places (x, y, ...) [m] that are named."""
        return [thing for thing in self.things or () if thing.state != "contained" and all(
            math.dist(thing.position[:2], place[:2]) > SAME for place in named)]

    def counted(self) -> dict[str, Any] | None:
        """How much lies in containers, on the table and anywhere else; None without simulated hardware."""
        if self.things is None:
            return None
        contained = _counts(self.containers, (t.container for t in self.things if t.state == "contained"))
        in_box, on_table = sum(contained.values()), sum(thing.state == "table" for thing in self.things)
        elsewhere = len(self.things) - in_box - on_table
        return {"in_box": in_box, "on_table": on_table, "elsewhere": elsewhere, "containers": contained}


def _counts(known: Iterable[str], found: Iterable[str]) -> dict[str, int]:
    counts = dict.fromkeys(known, 0)
    for name in found:
        counts[name] = counts.get(name, 0) + 1
    return counts
