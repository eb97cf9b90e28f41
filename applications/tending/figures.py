"""Figures of a tending run: parts on the pallet, and the state of the machine in the timeline."""

from __future__ import annotations

from typing import ClassVar

from applications.tending.task import PALLET
from common.config import Parameters
from common.messages import WorldObject, WorldObjects
from common.tasks.palletizing import Pattern, slot_at, slots
from common.tasks.stages import place_of
from recording.report import application


class Pallet(Parameters):
    """The pattern as the task reads it."""

    pallet: Pattern = PALLET


class TendingFigures(application.Figures):
    """Figures of every run."""

    COUNTED, IN_PLACE = "on the pallet", "parts on the pallet"
    STATE_COLORS: ClassVar = {"GRASPING": "#2f7ed8", "PLACING": "#17a398", "HOMING": "#8d6cc2", "MACHINING": "#e0a030"}

    def in_place(self, truth: WorldObjects) -> list[WorldObject]:
        """Return the parts with a slot of the pallet for themselves."""
        given = {"pallet": self.parameters["pallet"]} if "pallet" in self.parameters else {}
        pallet = Pallet.model_validate(given).pallet
        every = slots(pallet)
        taken = [slot_at(pallet, place_of(part.pose), every) for part in truth.objects]
        return [part for part, slot in zip(truth.objects, taken, strict=True)
                if slot is not None and part.state == "table" and sum(slot == other for other in taken) == 1]
