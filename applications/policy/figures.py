"""Figures of a run of a policy: what became of its chunks, and who had control."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from common import messages as m
from recording.report import application


class PolicyFigures(application.Figures):
    """The episode, and its chunks."""

    COUNTED = "episodes"
    STATE_COLORS: ClassVar = {"ACTING": "#2f7ed8", "ENDING": "#8d6cc2"}

    def progress(self, status: m.TaskStatus) -> str:
        """Return the progress of the task in a few words."""
        chunks, refused = getattr(status, "chunks", 0), getattr(status, "refused", 0)
        operator = ", the operator has control" if getattr(status, "control", "policy") == "operator" else ""
        return f"{status.state}, {chunks} chunks{f', {refused} refused' if refused else ''}{operator}"

    def headline(self, summary: Mapping[str, Any]) -> str:
        """Return the result of a run in a few words."""
        figures = summary.get("figures", {})
        counts = [f"{figures.get(name, 0)} {name}" for name in ("proved", "slowed", "shortened", "refused")]
        return f"{figures.get('chunks', 0)} chunks: {', '.join(counts)}"
