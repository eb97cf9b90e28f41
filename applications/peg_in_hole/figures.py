"""Figures of an insertion: pegs in the hole."""

from __future__ import annotations

from typing import ClassVar

from applications.peg_in_hole.task import Hole
from common.messages import WorldObject, WorldObjects
from common.tasks.stages import place_of
from recording.report import application


class InsertionFigures(application.Figures):
    """Figures of every run."""

    COUNTED, IN_PLACE = "inserted", "pegs in the hole"
    STATE_COLORS: ClassVar = {"GRASPING": "#2f7ed8", "PLACING": "#17a398", "HOMING": "#8d6cc2"}

    def in_place(self, truth: WorldObjects) -> list[WorldObject] | None:
        """Return the pegs in the hole."""
        if not (given := self.parameters.get("hole")):
            return None
        hole = Hole.model_validate(given)
        return [peg for peg in truth.objects if peg.state != "held" and hole.has(place_of(peg.pose), peg.size.z)]
