"""Figures of an insertion: pegs in the hole."""

from __future__ import annotations

from typing import ClassVar

from applications.peg_in_hole.task import Hole
from common.messages import WorldObjects
from common.tasks.stages import place_of
from recording.report import application


class InsertionFigures(application.Figures):
    """Figures of every run."""

    COUNTED = "inserted"
    STATE_COLORS: ClassVar = {"GRASPING": "#2f7ed8", "PLACING": "#17a398", "HOMING": "#8d6cc2"}

    def achieved(self, truth: WorldObjects) -> str:
        """Return the number of pegs in the hole."""
        if not (given := self.parameters.get("hole")):
            return ""
        hole = Hole.model_validate(given)
        inserted = sum(hole.has(place_of(peg.pose), peg.size.z) for peg in truth.objects if peg.state != "held")
        return f"{inserted} of {len(truth.objects)} pegs in the hole"
