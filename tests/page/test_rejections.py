"""Rejected places are forgotten by the clock of the cell, whatever that does."""

from __future__ import annotations

import pytest

from common import messages as m
from page.rejections import RejectedPositions

HOUR = 3600 * 10**9  # [ns]
AT = m.Vector3(x=0.5, y=0.1, z=0.03)


def seen(stamp: int, *places: m.Vector3) -> m.MarkerArray:
    size = m.Vector3(x=1, y=1, z=1)
    return m.MarkerArray(header=m.Header(stamp=stamp), markers=[
        m.Marker(ns="thing", id=k, type="sphere", pose=m.Pose(position=at), scale=size) for k, at in enumerate(places)])


@pytest.mark.parametrize("back", [0, HOUR], ids=["clock that goes on", "clock that was set back"])
def test_place_is_forgotten_when_nothing_is_seen_there_or_a_target_is(back: int) -> None:
    for last in (seen(2 * HOUR - back + 5 * 10**9), m.PoseArray(header=m.Header(stamp=2 * HOUR - back + 5 * 10**9),
                                                               poses=[m.Pose(position=AT)])):
        rejected = RejectedPositions()
        rejected.hear(m.Rejections(header=m.Header(stamp=2 * HOUR), rejected=[m.Rejection(position=AT, reason="far")]))
        rejected.hear(seen(2 * HOUR - back + 10**9, AT))
        assert [place.reason for place in rejected.places] == ["far"]
        rejected.hear(last)
        assert rejected.places == []
