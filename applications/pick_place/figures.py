"""Figures of a pick-and-place run: objects placed, and detections on the table."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from applications.pick_place.topics import DETECTED_OBJECTS, SCENE_BALLS, VALIDATED_TARGETS
from common.messages import MarkerArray, PoseArray
from common.topics import Topic
from recording.report import application

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from recording.report.history import RunHistory


class PickPlaceFigures(application.Figures):
    """Figures of every run, and the positions of detections and targets."""

    COUNTED = "placed"
    STATE_COLORS: ClassVar = {"GRASPING": "#2f7ed8", "PLACING": "#17a398", "HOMING": "#8d6cc2"}
    TRUTH = SCENE_BALLS

    def listeners(self) -> dict[Topic[Any], Callable[[float, Any], None]]:
        """Return listeners for detections and targets, if they are plotted."""
        self._detections: dict[tuple[int, int], int] = {}  # counts by position
        self._targets: dict[tuple[int, int], int] = {}
        if not self.for_report:
            return {}
        return {DETECTED_OBJECTS: self._on_detections, VALIDATED_TARGETS: self._on_targets}

    def _on_detections(self, _time: float, found: MarkerArray) -> None:
        from recording.report.history import count_positions

        count_positions(self._detections, (marker.pose for marker in found.markers))

    def _on_targets(self, _time: float, targets: PoseArray) -> None:
        from recording.report.history import count_positions

        count_positions(self._targets, targets.poses)

    def picture(self, run: RunHistory, tool: npt.NDArray[np.float64]) -> application.Section | None:
        """Return the top view of the table with the detections."""
        return application.top_view_section(run, tool, {"detections": self._detections, "targets": self._targets})
