"""Figures of an insertion: pegs in the hole."""

from __future__ import annotations

from typing import ClassVar

from recording.report import application


class InsertionFigures(application.Figures):
    """Figures of every run."""

    COUNTED = "inserted"
    STATE_COLORS: ClassVar = {"GRASPING": "#2f7ed8", "PLACING": "#17a398", "HOMING": "#8d6cc2"}
