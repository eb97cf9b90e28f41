"""Rejected positions are forgotten by the clock of the cell, also if it was set back."""

from __future__ import annotations

import pytest

from common import messages as m
from page.rejections import RejectedPositions

HOUR, SECOND = 3600 * 10**9, 10**9  # [ns]
AT = m.Vector3(x=0.5, y=0.1, z=0.03)


def detections(stamp: int, *positions: m.Vector3) -> m.MarkerArray:
    size = m.Vector3(x=1, y=1, z=1)
    return m.MarkerArray(header=m.Header(stamp=stamp), markers=[
        m.Marker(ns="object", id=k, type="sphere", pose=m.Pose(position=at), scale=size)
        for k, at in enumerate(positions)])


@pytest.mark.parametrize("back", [0, HOUR], ids=["normal clock", "clock set back"])
def test_position_is_forgotten_without_detections_or_with_a_target(back: int) -> None:
    now = 2 * HOUR - back
    target = m.PoseArray(header=m.Header(stamp=now + 5 * SECOND), poses=[m.Pose(position=AT)])
    for last in (detections(now + 5 * SECOND), target):
        rejected = RejectedPositions()
        rejection = m.Rejection(position=AT, reason="far")
        rejected.update(m.Rejections(header=m.Header(stamp=2 * HOUR), rejected=[rejection]))
        rejected.update(detections(now + SECOND, AT))
        assert [position.reason for position in rejected.positions] == ["far"]
        rejected.update(last)
        assert rejected.positions == []
