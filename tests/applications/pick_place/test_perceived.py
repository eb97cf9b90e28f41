"""The planning scene of detections and of the gripper: targets, the held object, what lies in containers."""

import math

import pytest

from applications.pick_place.perceived_scene import PerceivedScene
from applications.pick_place.tracks import SceneParameters
from common import messages as m
from common.config import Surroundings
from common.robot.transforms import matrix_to_rpy, pose_to_matrix, tool_down
from tests.applications.pick_place.rendered import AROUND, CELL, camera_of

AWAY, OVER_BOX = tool_down(0.3, 0.0, 0.5), tool_down(0.55, 0.25, 0.25)
LOW, HIGH = (0.517, 0.217, 0.035), (0.517, 0.217, 0.095)  # one above the other in the box


class Scene(PerceivedScene):
    """A perceived scene with the camera of its world."""

    def __init__(self, around=AROUND, **parameters):
        super().__init__(SceneParameters(**parameters), around, CELL.robot.gripper, "panda_hand_tcp")
        self.camera = camera_of(around)

    def see(self, stamps, *things, tcp=AWAY):
        """Process an image with these balls (x, y, z) or markers at each time [s]."""
        for stamp in stamps if isinstance(stamps, tuple) else (stamps,):
            markers = [thing if isinstance(thing, m.Marker) else self.marker(thing, k=k)
                       for k, thing in enumerate(things)]
            frame = m.MarkerArray(header=m.Header(stamp=int(stamp * 1e9), frame_id="world"), markers=markers)
            self.update_detections(frame, self.camera, tcp)

    def marker(self, place, shape="sphere", kind="ball", size=(0.06, 0.06, 0.06), yaw=0.0, k=0, pixel=True, **fields):
        position, orientation = m.Vector3(x=place[0], y=place[1], z=place[2]), m.Quaternion(
            z=math.sin(yaw / 2), w=math.cos(yaw / 2))
        return m.Marker(ns=kind, id=k, type=shape, scale=m.Vector3(x=size[0], y=size[1], z=size[2]),
                        pose=m.Pose(position=position, orientation=orientation),
                        pixel=tuple(self.camera.project(list(place))) if pixel else None, **fields)

    def grip(self, stamp, holding, tcp, width=0.0):
        state = m.GripperState(header=m.Header(stamp=int(stamp * 1e9)), holding=holding, width=width)
        self.update_gripper(state, tcp)

    def of(self, role):
        return [thing for thing in self.scene().objects if thing.role == role]

    def ids(self, role):
        return [thing.id for thing in self.of(role)]


def test_fixtures_and_five_panels_are_there_before_the_first_image():
    s = Scene()
    assert s.ids("fixture") == ["table"] and len(s.of("container")) == 5 and s.of("target") == []
    assert Scene(Surroundings()).scene().objects == [], "a world without containers has no panels"


def test_detected_ball_is_a_target_with_color_and_grip_effort_at_its_position():
    s = Scene(AROUND.model_copy(update={"grip_efforts": {"ball": 3.0}}))
    s.see((1.0, 1.1, 1.2), (0.5, -0.2, 0.03))
    (ball,) = s.of("target")
    assert (ball.pose.position.x, ball.pose.position.y) == pytest.approx((0.5, -0.2))
    assert ball.color.r > 0.9 and ball.grip_effort == 3.0
    s.grip(1.3, True, tool_down(0.5, -0.2, 0.03))
    assert s.scene().attached[0].object.grip_effort == 3.0


def test_held_ball_keeps_its_id_and_old_frames_are_ignored():
    s, balls = Scene(), ((0.4, 0.0, 0.03), (0.52, 0.0, 0.03))
    s.see((1.0, 1.1), *balls)
    ids = {thing.pose.position.x: thing.id for thing in s.of("target")}
    s.grip(1.25, True, tool_down(0.4, 0.0, 0.03))
    assert s.scene().attached[0].object.id == ids[0.4] and s.ids("target") == [ids[0.52]]
    s.see((1.2, 1.3), *balls, tcp=tool_down(0.4, 0.0, 0.03))
    assert s.ids("target") == [ids[0.52]]


def test_ball_held_at_the_start_is_attached_at_the_tool():
    s = Scene()
    s.grip(1.0, True, tool_down(0.4, 0.1, 0.2))
    (attached,) = s.scene().attached
    assert attached.link == "panda_hand_tcp" and attached.object.pose.position == m.Vector3()


@pytest.mark.parametrize("width", [0.0, 0.024, 0.06])
def test_held_object_that_no_detector_reported_has_the_width_of_the_fingers(width):
    s = Scene()
    s.grip(1.0, True, tool_down(0.4, 0.1, 0.012), width)
    thing = s.scene().attached[0].object
    assert (thing.shape, thing.kind, thing.dimensions[1]) == ("box", "", max(width, 0.001))
    assert thing.dimensions[2] <= 0.03, "a table 12 mm below the tool must not prevent a lift"
    s.see(1.1, (0.5, -0.2, 0.03), tcp=tool_down(0.4, 0.1, 0.2))
    after = s.scene().attached[0].object
    assert (after.id, after.shape) == (thing.id, "sphere" if width == 0.06 else "box"), "it may be a ball like others"


def test_scene_is_settled_up_to_the_newest_image_without_unconfirmed_objects():
    s, first, second = Scene(confirm_frames=3), (0.5, -0.2, 0.03), (0.4, -0.1, 0.03)
    s.see((1.0, 1.1), first)
    assert s.scene().settled == 0
    s.see(1.2, first)
    assert s.scene().settled is None
    s.see((1.3, 1.4), first, second)
    assert s.scene().settled == 1_200_000_000
    s.see(1.5, first)
    assert s.scene().settled is None, "it was an outlier"


def test_released_ball_in_the_container_is_contained():
    s = Scene()
    s.grip(1.0, True, OVER_BOX)
    s.grip(1.2, False, OVER_BOX)
    s.see(1.5, LOW)
    assert s.scene().attached == [] and s.ids("contained") == ["slot_1"] and s.of("target") == []


def after_release(*contained):
    """Return a scene in which the gripper took a ball and released it over the box at 2.1 s."""
    s = Scene()
    s.see(1.0, (0.4, 0.0, 0.03), *contained)
    s.grip(1.1, True, tool_down(0.4, 0.0, 0.03))
    s.see(2.0, tcp=OVER_BOX)
    s.grip(2.1, False, OVER_BOX)
    return s


@pytest.mark.parametrize(("before", "images", "slots"), [
    ((), [(2.2, HIGH), (2.3, HIGH), (4.0, HIGH)], ["slot_5"]),  # it falls past a free slot
    ((), [(2.2, HIGH), (4.0, HIGH), (4.1, LOW)], ["slot_1"]),
    ((LOW,), [(2.2, HIGH)], ["slot_1", "slot_5"]),  # it occludes the lower one
    ((), [(2.2, LOW), (2.5, LOW), (2.8, LOW), (2.9, HIGH)], ["slot_1", "slot_5"]),  # an operator placed another
    ((), [(2.2, LOW), (2.3, HIGH), (2.6, HIGH), (2.9, HIGH)], ["slot_5"]),  # it bounces through a free slot
])
def test_released_ball_counts_once_and_an_occluded_one_still_counts(before, images, slots):
    s = after_release(*before)
    for stamp, place in images:
        s.see(stamp, place)
    assert s.ids("contained") == slots


@pytest.mark.parametrize("holding", [False, True])
def test_occluded_ball_in_the_container_is_assumed_after_a_restart(holding):
    s = Scene()
    s.grip(1.0, holding, OVER_BOX)
    s.see(1.1, HIGH, tcp=OVER_BOX)
    assert s.ids("contained") == ["slot_1", "slot_5"]
    assert [thing.id for thing in s.scene().objects if thing.unseen] == ["slot_1"]


def test_scene_has_shape_size_color_and_yaw_of_the_detection_also_while_it_is_held():
    s = Scene()
    blue = m.Color(r=0, g=0.2, b=1)
    cube = s.marker((0.4, 0.0, 0.02), "box", "cube", (0.04, 0.05, 0.04), 0.3, color=blue, pixel=False)
    can = s.marker((0.6, -0.2, 0.05), "cylinder", "can", (0.05, 0.05, 0.1), k=1, pixel=False)
    note = m.Marker(ns="note", id=2, type="text", scale=m.Vector3(x=0.1), pose=m.Pose(), text="two things")
    s.see((1.0, 1.1), cube, can, note)
    box, cylinder = s.of("target")
    assert (box.shape, box.dimensions, box.color) == ("box", [0.04, 0.05, 0.04], blue)
    assert matrix_to_rpy(pose_to_matrix(box.pose)[:3, :3])[2] == pytest.approx(0.3)
    assert (cylinder.shape, cylinder.dimensions) == ("cylinder", [0.025, 0.1])
    hand = tool_down(0.402, 0.0, 0.02, 0.3)
    s.grip(1.2, True, hand, width=0.05)
    (held,) = s.scene().attached
    assert (held.object.shape, held.object.id) == ("box", box.id)
    T_world_box = hand @ pose_to_matrix(held.object.pose)
    assert matrix_to_rpy(T_world_box[:3, :3]) == pytest.approx((0.0, 0.0, 0.3), abs=1e-9)


def test_objects_in_any_container_are_contained_with_shape_and_kind():
    s = Scene(Surroundings.model_validate({"containers": {"left": {"y": 0.3}, "right": {"y": -0.3}}}), confirm_frames=1)
    assert len(s.of("container")) == 10
    s.see(1.0, *(s.marker(place, "box", kind, (0.04, 0.04, 0.04), k=k) for k, (kind, place) in enumerate(
        (("red", (0.4, 0.0, 0.02)), ("green", (0.55, 0.3, 0.025)), ("red", (0.55, -0.3, 0.025))))))
    found = [(o.role, o.kind, o.shape, round(o.pose.position.y, 2)) for o in s.scene().objects if o.kind]
    assert found == [("target", "red", "box", 0.0), ("contained", "green", "box", 0.3),
                     ("contained", "red", "box", -0.3)]
    assert s.ids("contained")[0] == "contained_1"


def test_object_above_the_table_gets_a_supporting_column():
    s = Scene(Surroundings(), confirm_frames=1)
    s.see(1.0, *(s.marker(place, "box", "cube", (0.04, 0.04, 0.04), k=k)
                 for k, place in enumerate(((0.4, 0.0, 0.02), (0.55, 0.1, 0.10)))))
    (column,) = s.of("fixture")
    assert column.dimensions == pytest.approx([0.04, 0.04, 0.08]) and column.pose.position.z == pytest.approx(0.04)
    assert (column.pose.position.x, column.pose.position.y) == (0.55, 0.1)


def thing(k, x, y, side=0.06):
    return Scene().marker((x, y, 0.1), "box", "thing", (side, side, side), k=k, pixel=False)


def test_marker_without_size_is_no_object():
    s = Scene()
    s.see((1.0, 1.1), thing(0, 0.4, 0.0, 0.0), thing(1, 0.4, 0.1, -1.0), thing(2, 0.6, 0.0))
    assert len(s.of("target")) == 1


def test_too_many_objects_on_the_table_or_in_a_container_are_reported():
    s = Scene()
    many = [thing(k, 0.2 + 0.1 * (k % 30), -2.0 + 0.1 * (k // 30)) for k in range(1000)]
    s.see((1.0, 1.1), *many)
    assert s.crowded and len(s.scene().objects) <= 500
    s.see((2.0, 2.1), many[0])
    assert not s.crowded and len(s.of("target")) == 1
    s.see(3.0, *(thing(k, 0.55, 0.25, 0.01) for k in range(600)))
    assert s.crowded and len(s.scene().objects) <= 500


def test_detections_of_a_wrong_clock_are_removed_by_the_next_frame():
    s = Scene()
    s.see((1000.0, 1000.1), thing(0, 0.4, 0.0))
    s.see((1.0, 1.1), thing(1, 0.6, 0.0))
    assert [round(o.pose.position.x, 3) for o in s.of("target")] == [0.6]
