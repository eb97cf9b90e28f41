from __future__ import annotations

import numpy as np

from common import messages as m
from common.applications.pick_place.perceived import PerceivedScene
from common.applications.pick_place.tracks import SceneParameters
from common.config import Surroundings, load_cell
from common.perception.pinhole import Pinhole
from common.robot.transforms import tool_down

CELL = load_cell("panda")
AROUND = CELL.section(Surroundings)
assert isinstance(AROUND, Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
AWAY = tool_down(0.3, 0.0, 0.5)


def scene() -> PerceivedScene:
    assert CELL.robot.gripper is not None
    return PerceivedScene(SceneParameters(), AROUND, CELL.robot.gripper, "panda_hand_tcp")


def frame(stamp: float, *balls: tuple[float, float, float]) -> m.MarkerArray:
    markers = []
    for k, (x, y, z) in enumerate(balls):
        u, v = CAMERA.project([x, y, z])
        markers.append(m.Marker(ns="ball", id=k, type="sphere", scale=m.Vector3(x=0.06, y=0.06, z=0.06), pixel=(u, v),
                                pose=m.Pose(position=m.Vector3(x=x, y=y, z=z))))
    return m.MarkerArray(header=m.Header(stamp=int(stamp * 1e9), frame_id="world"), markers=markers)


def gripper(stamp: float, holding: bool) -> m.GripperState:
    return m.GripperState(header=m.Header(stamp=int(stamp * 1e9)), holding=holding)


def roles(s: PerceivedScene) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for o in s.scene().objects:
        found.setdefault(o.role, []).append(o.id)
    return found


def test_fixtures_and_five_panels_are_there_before_anything_is_seen() -> None:
    found = roles(scene())
    assert found["fixture"] == ["table"]
    assert len(found["container"]) == 5
    assert "target" not in found


def test_taken_ball_keeps_its_id_in_the_hand_and_an_old_frame_does_not_bring_it_back() -> None:
    s = scene()
    for t in (1.0, 1.1):
        s.see(frame(t, (0.4, 0.0, 0.03), (0.52, 0.0, 0.03)), CAMERA, AWAY)
    ids = {o.pose.position.x: o.id for o in s.scene().objects if o.role == "target"}
    s.feel(gripper(1.25, True), tool_down(0.4, 0.0, 0.03))
    assert s.scene().attached[0].object.id == ids[0.4]
    assert roles(s)["target"] == [ids[0.52]]
    s.see(frame(1.2, (0.4, 0.0, 0.03), (0.52, 0.0, 0.03)), CAMERA, tool_down(0.4, 0.0, 0.03))
    s.see(frame(1.3, (0.4, 0.0, 0.03), (0.52, 0.0, 0.03)), CAMERA, tool_down(0.4, 0.0, 0.03))
    assert roles(s)["target"] == [ids[0.52]]


def test_ball_held_by_a_hand_that_was_never_seen_to_take_it_is_attached_at_the_tool() -> None:
    s = scene()
    s.feel(gripper(1.0, True), tool_down(0.4, 0.1, 0.2))
    attached = s.scene().attached[0]
    assert attached.link == "panda_hand_tcp"
    assert attached.object.pose.position == m.Vector3()


def test_opened_hand_holds_nothing_and_the_ball_in_the_box_is_contained() -> None:
    s = scene()
    s.feel(gripper(1.0, True), tool_down(0.55, 0.25, 0.25))
    s.feel(gripper(1.2, False), tool_down(0.55, 0.25, 0.25))
    s.see(frame(1.5, (0.517, 0.217, 0.035)), CAMERA, AWAY)
    assert s.scene().attached == []
    assert roles(s)["contained"] == ["slot_1"]
    assert "target" not in roles(s)


def test_perceived_place_is_where_the_ball_was_seen() -> None:
    s = scene()
    for t in (1.0, 1.1, 1.2):
        s.see(frame(t, (0.5, -0.2, 0.03)), CAMERA, AWAY)
    ball = next(o for o in s.scene().objects if o.role == "target")
    assert np.allclose([ball.pose.position.x, ball.pose.position.y], [0.5, -0.2])
    assert ball.color.r > 0.9
