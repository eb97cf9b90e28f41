"""Figures of a tending run: parts on the pallet, and the state of the machine in the timeline."""

from __future__ import annotations

from typing import ClassVar

from applications.tending.parts import misplaced
from applications.tending.task import PALLET
from common.config import Parameters
from common.messages import WorldObjects
from common.tasks.palletizing import Pattern
from recording.report import application


class Pallet(Parameters):
    """The pattern as the task reads it."""

    pallet: Pattern = PALLET


class TendingFigures(application.Figures):
    """Figures of every run."""

    COUNTED = "on the pallet"
    STATE_COLORS: ClassVar = {"GRASPING": "#2f7ed8", "PLACING": "#17a398", "HOMING": "#8d6cc2", "MACHINING": "#e0a030"}

    def achieved(self, truth: WorldObjects) -> str:
        """Return the number of parts in slots of the pallet."""
        given = {"pallet": self.parameters["pallet"]} if "pallet" in self.parameters else {}
        wrong = misplaced(truth, Pallet.model_validate(given).pallet)
        return f"{len(truth.objects) - len(wrong)} of {len(truth.objects)} parts on the pallet"
