"""Figures of a sorting run: attempts, success, picks an hour, objects by container, and the tries in a report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from applications.sorting.report import Tries
from common import messages as m
from common.config import RobotConfig
from common.topics import Topic
from recording.report import application

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from recording.report.history import RunHistory


class SortingFigures(application.Figures):
    """Figures of every run; a report also shows the tries."""

    COUNTED = "sorted"
    STATE_COLORS: ClassVar = {"GRASPING": "#2f7ed8", "CHECKING": "#e0a030", "PLACING": "#17a398",
                              "STIRRING": "#c05050", "HOMING": "#8d6cc2"}

    def __init__(self, robot: RobotConfig | None = None, *, for_report: bool = False) -> None:
        """Start without messages: see `Figures`."""
        super().__init__(robot, for_report=for_report)
        axis = robot.gripper.closing_axis if robot is not None and robot.gripper is not None else "y"
        self._tries = Tries(0 if axis == "x" else 1) if for_report else None

    def listeners(self) -> dict[Topic[Any], application.Listener]:
        """Return listeners of the tries, if they are shown."""
        return self._tries.listeners() if self._tries is not None else {}

    def progress(self, status: m.TaskStatus) -> str:
        """Return the progress of the task in a few words."""
        line = super().progress(status)
        attempts = getattr(status, "attempts", 0)
        return f"{line} ({attempts} attempts)" if attempts else line

    def headline(self, summary: Mapping[str, Any]) -> str:
        """Return the result of a run in a few words."""
        line, figures = super().headline(summary), summary.get("figures", {})
        hour = figures.get("picks_per_hour")
        return f"{line}, {figures.get('attempts', 0)} attempts{f', {hour:g} picks an hour' if hour else ''}"

    def picture(self, run: RunHistory, tool: npt.NDArray[np.float64]) -> application.Section | None:
        """Return the tries."""
        return self._tries.section() if self._tries is not None else super().picture(run, tool)
