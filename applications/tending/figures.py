"""Figures of a tending run: parts on the pallet, and the state of the machine in the timeline."""

from __future__ import annotations

from typing import ClassVar

from recording.report import application


class TendingFigures(application.Figures):
    """Figures of every run."""

    COUNTED = "on the pallet"
    STATE_COLORS: ClassVar = {"GRASPING": "#2f7ed8", "PLACING": "#17a398", "HOMING": "#8d6cc2", "MACHINING": "#e0a030"}
