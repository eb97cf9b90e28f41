"""Outlines for Foxglove."""

from __future__ import annotations

from typing import Any

from applications.outlining.messages import OutlinePoints
from common.messages import Color
from recording.foxglove_scene import closed_line, entity, update

COLOR = Color(r=0.1, g=0.9, b=0.3)


def of_outline(message: OutlinePoints) -> dict[str, Any]:
    """An outline as a closed line."""
    points = [(pose.position.x, pose.position.y, pose.position.z) for pose in message.poses]
    lines, stamp = [closed_line(points, COLOR)] if points else [], message.header.stamp
    return update(stamp, [entity(message.object or "outline", message.header.frame_id, stamp, lines=lines)])


FOXGLOVE = [(OutlinePoints, "foxglove.SceneUpdate", of_outline)]
