"""Targets, rejections and workspace of pick and place in the scene."""

import numpy as np
import pytest

from applications.pick_place.topics import DETECTED_OBJECTS, REJECTED_TARGETS, VALIDATED_TARGETS, WORKSPACE_MARKERS
from common import messages as m
from page.status_text import RejectedPositions
from tests.page.scene_cell import WORLD, Stage, at

TOO_FAR = "too far: 0.873 m from the base axis, more than 0.820 m"
SECOND = 1_000_000_000  # [ns]
HOUR = 3600 * SECOND
Position = tuple[float, float]


def rejection(x: float, y: float, reason: str, stamp: int = 1) -> m.Rejections:
    position = m.Vector3(x=x, y=y, z=0.03)
    return m.Rejections(header=m.Header(stamp=stamp), rejected=[m.Rejection(position=position, reason=reason)])


def detections(stamp: int, *positions: Position) -> m.MarkerArray:
    size = m.Vector3(x=0.06, y=0.06, z=0.06)
    return m.MarkerArray(header=m.Header(stamp=stamp), markers=[
        m.Marker(ns="balls", id=i, type="sphere", pose=at(x, y, 0.03), scale=size)
        for i, (x, y) in enumerate(positions)])


def targets(*positions: Position, stamp: int = 1) -> m.PoseArray:
    return m.PoseArray(header=m.Header(stamp=stamp), poses=[at(x, y, 0.03) for x, y in positions])


def test_each_target_has_a_ring(panda: Stage) -> None:
    for positions in ([(0.4, 0.1)], [(0.4, 0.1), (0.5, -0.1)], [(0.3, 0.2), (0.5, -0.1)]):
        panda.say(VALIDATED_TARGETS, targets(*positions))
        np.testing.assert_allclose([node.position[:2] for node in panda.layer("targets").nodes], positions, atol=1e-6)
    panda.say(VALIDATED_TARGETS, targets())
    assert panda.layer("targets").nodes == []
    assert not [name for name in panda.server.scene._handle_from_node_name if name.startswith("/targets/")]


def test_rejected_position_is_labeled_with_its_newest_reason_until_it_is_a_target(panda: Stage) -> None:
    layer = panda.layer("rejected")
    panda.say(REJECTED_TARGETS, rejection(0.82, 0.3, TOO_FAR))
    assert layer.labels.texts == [TOO_FAR]
    (_, node), = layer.nodes.values()
    np.testing.assert_allclose(node.position, [0.82, 0.3, 0.03])
    panda.say(REJECTED_TARGETS, rejection(0.1, 0.0, "too close"))
    panda.say(REJECTED_TARGETS, rejection(0.825, 0.3, "partly out of view"))
    assert layer.reasons == ["too close", "partly out of view"]
    panda.say(VALIDATED_TARGETS, targets((0.82, 0.31)))
    assert layer.reasons == ["too close"]
    panda.say(DETECTED_OBJECTS, detections(20 * SECOND, (0.4, 0.1)))
    assert layer.reasons == []


@pytest.mark.parametrize("now", [2 * HOUR, HOUR], ids=["normal clock", "clock set back"])
@pytest.mark.parametrize("is_target", [False, True])
def test_position_is_forgotten_some_time_after_its_last_detection_or_as_a_target(now: int, is_target: bool) -> None:
    rejected = RejectedPositions()
    rejected.update(rejection(0.5, 0.1, TOO_FAR, stamp=2 * HOUR))
    rejected.update(detections(now + SECOND, (0.5, 0.1)))
    rejected.update(detections(now + 3 * SECOND, (0.4, 0.1)))  # it may be occluded by the arm
    assert [position.reason for position in rejected.positions] == [TOO_FAR]
    end = now + 5 * SECOND
    rejected.update(targets((0.5, 0.1), stamp=end) if is_target else detections(end, (0.4, 0.1)))
    assert rejected.positions == []


def test_number_of_displayed_rejections_is_bounded(panda: Stage) -> None:
    for index in range(70):
        panda.say(REJECTED_TARGETS, rejection(0.1 * index, 0.0, f"reason {index}"))
    assert len(panda.layer("rejected").reasons) == 60 and panda.layer("rejected").reasons[-1] == "reason 69"


def test_workspace_is_a_translucent_cylinder_that_is_sent_once(panda: Stage) -> None:
    panda.show("workspace", True)
    shell = m.Marker(ns="workspace", id=0, type="cylinder", pose=at(0, 0, 0.4), scale=m.Vector3(x=1.6, y=1.6, z=1.0),
                     color=m.Color(r=0.2, g=0.8, b=0.3, a=0.15))
    panda.say(WORKSPACE_MARKERS, m.MarkerArray(header=WORLD, markers=[shell]))
    _, wall = panda.layer("workspace").markers.nodes
    np.testing.assert_allclose(np.linalg.norm(wall.vertices[:, :2], axis=1), 0.8, atol=1e-6)
    assert np.ptp(wall.vertices[:, 2]) == 1.0 and wall.opacity == 0.15 and wall.position[2] == 0.4
    with panda.sent() as sent:
        panda.say(WORKSPACE_MARKERS, m.MarkerArray(header=WORLD, markers=[shell]))
    assert not sent


def test_markers_of_every_type_are_displayed(panda: Stage) -> None:
    panda.show("workspace", True)
    types = ("sphere", "box", "text", "cylinder")
    panda.say(WORKSPACE_MARKERS, m.MarkerArray(header=WORLD, markers=[
        m.Marker(ns="x", id=i, type=each, pose=at(0, 0, i), scale=m.Vector3(x=1, y=1, z=1), text="a wall")
        for i, each in enumerate(types)]))
    assert len(panda.layer("workspace").markers.nodes) == len(types) + 1  # a cylinder has rims
