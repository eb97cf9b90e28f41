"""Figures of a tending run: parts on the pallet, and the state of the machine in the timeline."""

from __future__ import annotations

from typing import ClassVar

from applications.tending.parts import misplaced
from applications.tending.task import PALLET
from common.messages import WorldObjects
from common.tasks.palletizing import Pattern
from recording.report import application


class TendingFigures(application.Figures):
    """Figures of every run."""

    COUNTED = "on the pallet"
    STATE_COLORS: ClassVar = {"GRASPING": "#2f7ed8", "PLACING": "#17a398", "HOMING": "#8d6cc2", "MACHINING": "#e0a030"}

    def achieved(self, truth: WorldObjects) -> str:
        """Return the number of parts in slots of the pallet."""
        default = PALLET.model_dump(exclude_unset=True)
        wrong = misplaced(truth, Pattern.model_validate({**default, **self.parameters.get("pallet", {})}))
        return f"{len(truth.objects) - len(wrong)} of {len(truth.objects)} parts on the pallet"
