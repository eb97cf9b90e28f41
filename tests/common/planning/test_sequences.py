"""Sequences of single motions with blends."""

import numpy as np
import pytest
from pydantic import ValidationError

from common.messages import ArcGoal, JointGoal, PlanRequest, SequenceGoal, SequenceItem, Vector3
from common.planning.problem import Cancel, Result
from tests.common.planning.checks import assert_refused, planned, tool_places, with_planner
from tests.common.planning.requests import RIGHT, down, to
from tests.common.planning.scenes import EMPTY, HOME, ROBOT

PIPELINE = with_planner("sequence")
MIDDLE, ABOVE, LEFT_ABOVE = (0.5, 0.0, 0.2), (0.5, 0.0, 0.4), (0.5, 0.3, 0.4)


def line_to(x, y, z, blend_radius=0.0) -> SequenceItem:
    return SequenceItem(goal=down(x, y, z), straight=True, blend_radius=blend_radius)


def sequence(*items: SequenceItem) -> PlanRequest:
    return to(SequenceGoal(items=list(items)), RIGHT, stage="weave")


def corners(radius: float) -> PlanRequest:
    return sequence(line_to(*MIDDLE, radius), line_to(*ABOVE, radius), line_to(*LEFT_ABOVE))


def stops(timed) -> int:
    """Number of stops between start and end."""
    return int((np.abs(timed.velocities[1:-1]).max(axis=1) < 1e-9).sum())


def test_lines_without_a_blend_stop_at_their_corners():
    timed = planned(PIPELINE, corners(0.0), EMPTY)
    assert stops(timed) == 2
    for corner in (MIDDLE, ABOVE, LEFT_ABOVE):
        assert np.linalg.norm(tool_places(timed) - corner, axis=1).min() < 1e-4


@pytest.mark.parametrize("radius", [0.02, 0.08])
def test_corner_is_blended_within_its_radius_without_a_stop(radius):
    timed = planned(PIPELINE, corners(radius), EMPTY)
    assert stops(timed) == 0
    way = tool_places(timed)
    for corner in (MIDDLE, ABOVE):
        assert 0.1 * radius < np.linalg.norm(way - corner, axis=1).min() < radius
    outside = np.linalg.norm(way[:, None] - np.array([MIDDLE, ABOVE]), axis=2).min(axis=1) > radius
    on_lines = np.stack([
        np.hypot(way[:, 0] - 0.5, way[:, 2] - 0.2), np.hypot(way[:, 0] - 0.5, way[:, 1]),
        np.hypot(way[:, 0] - 0.5, way[:, 2] - 0.4),
    ]).min(axis=0)
    assert on_lines[outside].max() < 3e-4
    assert np.allclose(ROBOT.fk(timed.positions[-1])[:3, 3], LEFT_ABOVE, atol=1e-4)
    assert timed.duration < planned(PIPELINE, corners(0.0), EMPTY).duration


def test_sequence_of_point_to_point_arc_and_line():
    arc = ArcGoal(pose=down(0.5, 0.2, 0.3).pose, via=Vector3(x=0.55, y=0.1, z=0.35))
    timed = planned(PIPELINE, sequence(
        SequenceItem(goal=down(0.5, 0.0, 0.3), blend_radius=0.04), SequenceItem(goal=arc, blend_radius=0.03),
        line_to(0.4, 0.2, 0.3), SequenceItem(goal=JointGoal(named="home"))), EMPTY)
    assert np.allclose(timed.positions[-1], HOME, atol=1e-6)
    assert stops(timed) == 1
    assert np.linalg.norm(tool_places(timed) - (0.55, 0.1, 0.35), axis=1).min() < 1e-3


@pytest.mark.parametrize(("request_", "code", "text"), [
    (corners(0.15), "bad_goal", "weave: sequence: blend of items 2 and 3 of 3: blend_radius 0.15 m reaches"),
    (sequence(line_to(*MIDDLE, 0.02), line_to(1.2, 0.0, 0.2), line_to(*MIDDLE)), "no_ik", "item 2 of 3: waypoint "),
    (sequence(SequenceItem(goal=JointGoal(named="home"), straight=True)), "bad_goal", "item 1 of 1"),
])
def test_impossible_item_or_blend_is_refused_with_its_number(request_, code, text):
    response = PIPELINE.plan(request_, EMPTY)
    assert_refused(response, code, text)
    assert code != "no_ik" or 1 / 3 < response.fraction < 2 / 3


def test_colliding_blend_is_reported(monkeypatch):
    hit = Result(error="collision", message="waypoint 3 of 9: a collides with b", waypoint=3, colliding=("a", "b"))
    monkeypatch.setattr("common.planning.planners.sequence.blocked", lambda *_: hit)
    response = PIPELINE.plan(corners(0.05), EMPTY)
    text = "weave: sequence: blend of items 1 and 2 of 3: waypoint 3 of 9: a collides with b"
    assert (response.error, response.colliding, response.message) == ("collision", ("a", "b"), text)


def test_cancelling_ends_a_sequence():
    cancel = Cancel()
    cancel.set()
    assert PIPELINE.plan(corners(0.02), EMPTY, cancel=cancel).error == "cancelled"


def test_last_item_cannot_have_a_blend_radius():
    with pytest.raises(ValidationError, match="nothing follows"):
        SequenceGoal(items=[line_to(*MIDDLE, 0.1)])
