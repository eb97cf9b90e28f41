from __future__ import annotations

import math

import numpy as np
import pytest

from applications.pick_place.perceived_scene import PerceivedScene, SceneParameters
from common import messages as m
from common.config import Surroundings, load_cell
from common.perception.pinhole import Pinhole
from common.robot.transforms import matrix_to_rpy, pose_to_matrix, tool_down

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


def test_held_ball_keeps_its_id_and_old_frames_are_ignored() -> None:
    s = scene()
    for t in (1.0, 1.1):
        s.update_detections(frame(t, (0.4, 0.0, 0.03), (0.52, 0.0, 0.03)), CAMERA, AWAY)
    ids = {o.pose.position.x: o.id for o in s.scene().objects if o.role == "target"}
    s.update_gripper(gripper(1.25, True), tool_down(0.4, 0.0, 0.03))
    assert s.scene().attached[0].object.id == ids[0.4]
    assert roles(s)["target"] == [ids[0.52]]
    s.update_detections(frame(1.2, (0.4, 0.0, 0.03), (0.52, 0.0, 0.03)), CAMERA, tool_down(0.4, 0.0, 0.03))
    s.update_detections(frame(1.3, (0.4, 0.0, 0.03), (0.52, 0.0, 0.03)), CAMERA, tool_down(0.4, 0.0, 0.03))
    assert roles(s)["target"] == [ids[0.52]]


def test_ball_held_at_the_start_is_attached_at_the_tool() -> None:
    s = scene()
    s.update_gripper(gripper(1.0, True), tool_down(0.4, 0.1, 0.2))
    attached = s.scene().attached[0]
    assert attached.link == "panda_hand_tcp"
    assert attached.object.pose.position == m.Vector3()


def test_released_ball_in_the_container_is_contained() -> None:
    s = scene()
    s.update_gripper(gripper(1.0, True), tool_down(0.55, 0.25, 0.25))
    s.update_gripper(gripper(1.2, False), tool_down(0.55, 0.25, 0.25))
    s.update_detections(frame(1.5, (0.517, 0.217, 0.035)), CAMERA, AWAY)
    assert s.scene().attached == []
    assert roles(s)["contained"] == ["slot_1"]
    assert "target" not in roles(s)


LOW, HIGH = (0.517, 0.217, 0.035), (0.517, 0.217, 0.095)  # one above the other in the box
OVER_BOX = tool_down(0.55, 0.25, 0.25)


def test_falling_ball_above_a_free_slot_counts_once() -> None:
    s = scene()
    s.update_detections(frame(1.0, (0.4, 0.0, 0.03)), CAMERA, AWAY)
    s.update_gripper(gripper(1.1, True), tool_down(0.4, 0.0, 0.03))
    s.update_detections(frame(2.0), CAMERA, OVER_BOX)
    s.update_gripper(gripper(2.1, False), OVER_BOX)
    for t in (2.2, 2.3, 4.0):
        s.update_detections(frame(t, HIGH), CAMERA, AWAY)
        assert roles(s)["contained"] == ["slot_5"]
    s.update_detections(frame(4.1, LOW), CAMERA, AWAY)
    assert roles(s)["contained"] == ["slot_1"]


def test_ball_occluded_by_the_released_one_still_counts() -> None:
    s = scene()
    s.update_detections(frame(1.0, (0.4, 0.0, 0.03), LOW), CAMERA, AWAY)
    s.update_gripper(gripper(1.1, True), tool_down(0.4, 0.0, 0.03))
    s.update_detections(frame(2.0), CAMERA, OVER_BOX)
    s.update_gripper(gripper(2.1, False), OVER_BOX)
    s.update_detections(frame(2.2, HIGH), CAMERA, AWAY)
    assert roles(s)["contained"] == ["slot_1", "slot_5"]


def test_ball_in_a_former_free_slot_carries_the_next_one() -> None:
    s = scene()
    s.update_detections(frame(1.0, (0.4, 0.0, 0.03)), CAMERA, AWAY)
    s.update_gripper(gripper(1.1, True), tool_down(0.4, 0.0, 0.03))
    s.update_gripper(gripper(2.1, False), OVER_BOX)
    for t in (2.2, 2.5, 2.8):
        s.update_detections(frame(t, LOW), CAMERA, AWAY)
    s.update_detections(frame(2.9, HIGH), CAMERA, AWAY)  # placed by an operator
    assert roles(s)["contained"] == ["slot_1", "slot_5"]


def test_ball_bouncing_through_a_free_slot_counts_once() -> None:
    s = scene()
    s.update_detections(frame(1.0, (0.4, 0.0, 0.03)), CAMERA, AWAY)
    s.update_gripper(gripper(1.1, True), tool_down(0.4, 0.0, 0.03))
    s.update_gripper(gripper(2.1, False), OVER_BOX)
    s.update_detections(frame(2.2, LOW), CAMERA, AWAY)  # it bounces
    for t in (2.3, 2.6, 2.9):
        s.update_detections(frame(t, HIGH), CAMERA, AWAY)
    assert roles(s)["contained"] == ["slot_5"]


@pytest.mark.parametrize("holding", [False, True])
def test_occluded_ball_in_the_container_is_assumed_after_a_restart(holding: bool) -> None:
    s = scene()
    s.update_gripper(gripper(1.0, holding), OVER_BOX)
    s.update_detections(frame(1.1, HIGH), CAMERA, OVER_BOX)
    assert roles(s)["contained"] == ["slot_1", "slot_5"]
    assert [thing.id for thing in s.scene().objects if thing.unseen] == ["slot_1"]


def test_perceived_position_is_the_detected_position() -> None:
    s = scene()
    for t in (1.0, 1.1, 1.2):
        s.update_detections(frame(t, (0.5, -0.2, 0.03)), CAMERA, AWAY)
    ball = next(o for o in s.scene().objects if o.role == "target")
    assert np.allclose([ball.pose.position.x, ball.pose.position.y], [0.5, -0.2])
    assert ball.color.r > 0.9


def cube(x: float, y: float, yaw: float, *, u_v: tuple[float, float] | None = None) -> m.Marker:
    z = math.sin(yaw / 2), math.cos(yaw / 2)
    pose = m.Pose(position=m.Vector3(x=x, y=y, z=0.02), orientation=m.Quaternion(z=z[0], w=z[1]))
    return m.Marker(ns="cube", id=0, type="box", scale=m.Vector3(x=0.04, y=0.05, z=0.04), pose=pose,
                    color=m.Color(r=0, g=0.2, b=1), pixel=u_v)


def shown(stamp: float, *markers: m.Marker) -> m.MarkerArray:
    return m.MarkerArray(header=m.Header(stamp=int(stamp * 1e9), frame_id="world"), markers=list(markers))


def test_scene_has_shape_size_color_and_yaw_of_the_detection() -> None:
    s = scene()
    can = m.Marker(ns="can", id=1, type="cylinder", scale=m.Vector3(x=0.05, y=0.05, z=0.1),
                   pose=m.Pose(position=m.Vector3(x=0.6, y=-0.2, z=0.05)))
    note = m.Marker(ns="note", id=2, type="text", scale=m.Vector3(x=0.1), pose=m.Pose(), text="two things")
    for t in (1.0, 1.1):
        s.update_detections(shown(t, cube(0.4, 0.0, 0.3), can, note), CAMERA, AWAY)
    box, cylinder = (o for o in s.scene().objects if o.role == "target")
    assert (box.shape, box.dimensions, box.color) == ("box", [0.04, 0.05, 0.04], m.Color(r=0, g=0.2, b=1))
    assert matrix_to_rpy(pose_to_matrix(box.pose)[:3, :3])[2] == pytest.approx(0.3)
    assert (cylinder.shape, cylinder.dimensions) == ("cylinder", [0.025, 0.1])


def test_held_box_keeps_shape_and_yaw() -> None:
    s = scene()
    for t in (1.0, 1.1):
        s.update_detections(shown(t, cube(0.4, 0.0, 0.3)), CAMERA, AWAY)
    hand = tool_down(0.402, 0.0, 0.02, 0.3)
    s.update_gripper(gripper(1.2, True).model_copy(update={"width": 0.05}), hand)
    (held,) = s.scene().attached
    assert (held.object.shape, held.object.id) == ("box", "track_1")
    T_world_box = hand @ pose_to_matrix(held.object.pose)
    assert matrix_to_rpy(T_world_box[:3, :3]) == pytest.approx((0.0, 0.0, 0.3), abs=1e-9)


def test_box_in_the_container_keeps_its_kind() -> None:
    s = scene()
    c = AROUND.container
    u, v = CAMERA.project([c.x, c.y, 0.025])
    s.update_detections(shown(1.0, cube(c.x, c.y, 0.0, u_v=(u, v))), CAMERA, AWAY)
    (inside,) = (o for o in s.scene().objects if o.role == "contained")
    assert (inside.id, inside.shape) == ("contained_1", "box")


def test_objects_carry_the_grip_effort_of_their_kind() -> None:
    around = AROUND.model_copy(update={"grip_efforts": {"ball": 3.0}})
    assert CELL.robot.gripper is not None
    s = PerceivedScene(SceneParameters(), around, CELL.robot.gripper, "panda_hand_tcp")
    for t in (1.0, 1.1):
        s.update_detections(frame(t, (0.4, 0.0, 0.03)), CAMERA, AWAY)
    assert [o.grip_effort for o in s.scene().objects if o.role == "target"] == [3.0]
    s.update_gripper(gripper(1.2, True), tool_down(0.4, 0.0, 0.03))
    assert s.scene().attached[0].object.grip_effort == 3.0


def boxes(stamp: float, camera: Pinhole, *places: tuple[str, float, float, float]) -> m.MarkerArray:
    markers = []
    for k, (kind, x, y, z) in enumerate(places):
        u, v = camera.project([x, y, z])
        markers.append(m.Marker(ns=kind, id=k, type="box", scale=m.Vector3(x=0.04, y=0.04, z=0.04), pixel=(u, v),
                                pose=m.Pose(position=m.Vector3(x=x, y=y, z=z))))
    return m.MarkerArray(header=m.Header(stamp=int(stamp * 1e9), frame_id="world"), markers=markers)


def test_objects_in_any_container_are_contained_with_their_kind() -> None:
    around = Surroundings.model_validate({"containers": {"left": {"y": 0.3}, "right": {"y": -0.3}}})
    camera = Pinhole.from_config(around.camera)
    assert CELL.robot.gripper is not None
    s = PerceivedScene(SceneParameters(confirm_frames=1), around, CELL.robot.gripper, "panda_hand_tcp")
    assert sum(o.role == "container" for o in s.scene().objects) == 10
    s.update_detections(
        boxes(1.0, camera, ("red", 0.4, 0.0, 0.02), ("green", 0.55, 0.3, 0.025), ("red", 0.55, -0.3, 0.025)),
        camera, AWAY)
    found = [(o.role, o.kind, round(o.pose.position.y, 2)) for o in s.scene().objects if o.kind]
    assert found == [("target", "red", 0.0), ("contained", "green", 0.3), ("contained", "red", -0.3)]


def test_a_world_without_containers_has_no_panels() -> None:
    around = Surroundings()
    assert CELL.robot.gripper is not None
    s = PerceivedScene(SceneParameters(), around, CELL.robot.gripper, "panda_hand_tcp")
    assert s.scene().objects == []


def test_object_above_the_table_gets_a_supporting_column() -> None:
    around = Surroundings()
    camera = Pinhole.from_config(around.camera)
    assert CELL.robot.gripper is not None
    s = PerceivedScene(SceneParameters(confirm_frames=1), around, CELL.robot.gripper, "panda_hand_tcp")
    s.update_detections(boxes(1.0, camera, ("red", 0.4, 0.0, 0.02), ("green", 0.55, 0.1, 0.10)), camera, AWAY)
    column, = [o for o in s.scene().objects if o.role == "fixture"]
    assert column.dimensions == pytest.approx([0.04, 0.04, 0.08]) and column.pose.position.z == pytest.approx(0.04)
    assert (column.pose.position.x, column.pose.position.y) == (0.55, 0.1)


def thing(k: int, x: float, y: float, side: float = 0.06) -> m.Marker:
    return m.Marker(ns="thing", id=k, type="box", scale=m.Vector3(x=side, y=side, z=side),
                    pose=m.Pose(position=m.Vector3(x=x, y=y, z=0.1)))


def frame_of(stamp: float, *markers: m.Marker) -> m.MarkerArray:
    return m.MarkerArray(header=m.Header(stamp=int(stamp * 1e9), frame_id="world"), markers=list(markers))


@pytest.mark.parametrize("side", [0.0, -1.0])
def test_marker_without_size_is_no_object(side: float) -> None:
    s = scene()
    for t in (1.0, 1.1):
        s.update_detections(frame_of(t, thing(0, 0.4, 0.0, side), thing(1, 0.6, 0.0)), CAMERA, AWAY)
    assert len(roles(s)["target"]) == 1


def test_too_many_objects_are_reported() -> None:
    s = scene()
    many = [thing(k, 0.2 + 0.1 * (k % 30), -2.0 + 0.1 * (k // 30)) for k in range(1000)]
    for t in (1.0, 1.1):
        s.update_detections(frame_of(t, *many), CAMERA, AWAY)
    assert s.crowded and len(s.scene().objects) <= 500
    for t in (2.0, 2.1):
        s.update_detections(frame_of(t, many[0]), CAMERA, AWAY)
    assert not s.crowded and len(roles(s)["target"]) == 1


def test_too_many_objects_in_a_container_are_reported() -> None:
    s = scene()
    s.update_detections(frame_of(1.0, *(thing(k, 0.55, 0.25, 0.01) for k in range(600))), CAMERA, AWAY)
    assert s.crowded and len(s.scene().objects) <= 500


def test_detections_of_a_wrong_clock_are_removed_by_the_next_frame() -> None:
    s = scene()
    for t in (1000.0, 1000.1):
        s.update_detections(frame_of(t, thing(0, 0.4, 0.0)), CAMERA, AWAY)
    for t in (1.0, 1.1):
        s.update_detections(frame_of(t, thing(1, 0.6, 0.0)), CAMERA, AWAY)
    assert [round(o.pose.position.x, 3) for o in s.scene().objects if o.role == "target"] == [0.6]
