"""The planning scene has seen objects as prisms, foreign bodies as boxes, and the held object at the tool."""

import numpy as np
import pytest
from pydantic import ValidationError

from applications.sorting.scene import GROWN, SortingScene, distance_to, prism
from applications.sorting.topics import Foreign, Heap, SeenObject
from common.config import load_cell
from common.messages import GripperState, Header, Vector3
from common.robot.transforms import pose_to_matrix, tool_down


@pytest.fixture(scope="module")
def world():
    return load_cell("sorting").world


def thing(name="o1", x=0.5, place="tray"):
    outline = [(x - 0.03, -0.02), (x + 0.03, -0.02), (x + 0.03, 0.02), (x - 0.03, 0.02)]
    return SeenObject(id=name, place=place, center=Vector3(x=x, z=0.04), size=Vector3(x=0.06, y=0.04, z=0.035),
                      outline=outline, top=0.04, bottom=0.005)


def heap(*objects, stamp=1, at_home=True, foreign=()):
    return Heap(header=Header(stamp=stamp), at_home=at_home, objects=list(objects), foreign=list(foreign))


def found(scene, name):
    return next((each for each in scene.scene().objects if each.id == name), None)


def test_seen_object_is_a_prism_from_its_support_to_its_top(world):
    scene = SortingScene(world, "tool")
    scene.update_heap(heap(thing(), thing("o2", 0.45, "left")))
    solid = found(scene, "o1")
    assert (solid.shape, solid.role, found(scene, "o2").role) == ("prism", "target", "contained")
    assert solid.dimensions == pytest.approx([0.035]) and solid.pose.position.z == pytest.approx(0.0225)
    assert np.ptp(solid.outline, axis=0) == pytest.approx([0.06, 0.04])


def test_objects_stay_as_seen_from_home_while_foreign_bodies_are_always_new(world):
    scene = SortingScene(world, "tool")
    scene.update_heap(heap(thing(), stamp=1))
    body = Foreign(center=Vector3(x=0.4, z=0.3), size=Vector3(x=0.1, y=0.1, z=0.2))
    scene.update_heap(heap(stamp=2, at_home=False, foreign=[body]))
    now = scene.scene()
    assert found(scene, "o1") is not None and found(scene, "foreign_1").kind == "foreign"
    assert (now.header.stamp, now.settled) == (2, 1)
    scene.update_heap(heap(stamp=3, at_home=False))
    assert found(scene, "foreign_1") is None


def test_gripped_object_moves_with_the_tool_and_is_larger_than_it_was_seen(world):
    scene = SortingScene(world, "tool")
    scene.update_heap(heap(thing(), thing("o2", 0.58)))
    T = tool_down(0.505, 0.0, 0.02, 0.3)
    assert scene.update_gripper(GripperState(holding=True, width=0.04), T)
    held = scene.scene().attached[0]
    assert (held.link, held.object.id) == ("tool", "o1") and found(scene, "o1") is None and found(scene, "o2")
    at = (T @ pose_to_matrix(held.object.pose))[:3, 3]
    assert at == pytest.approx([0.5, 0.0, 0.0225], abs=1e-9)
    assert held.object.dimensions == pytest.approx([0.035 + 2 * GROWN])
    assert scene.update_gripper(GripperState(holding=False), T) and not scene.scene().attached


def test_object_that_was_never_seen_is_held_as_a_box_as_wide_as_the_fingers_are_apart(world):
    scene = SortingScene(world, "tool")
    scene.update_heap(heap(thing()))
    assert scene.update_gripper(GripperState(holding=True, width=0.03), tool_down(0.7, 0.1, 0.02))
    assert scene.scene().attached[0].object.dimensions[1] == pytest.approx(0.03) and found(scene, "o1")


def test_grasp_waits_for_the_pose_of_the_tool(world):
    scene = SortingScene(world, "tool")
    assert not scene.update_gripper(GripperState(holding=True), None)
    assert scene.update_gripper(GripperState(holding=True), tool_down(0.5, 0.0, 0.02))


def test_later_object_with_the_id_of_the_held_one_is_renamed(world):
    scene = SortingScene(world, "tool")
    scene.update_heap(heap(thing()))
    scene.update_gripper(GripperState(holding=True), tool_down(0.5, 0.0, 0.02))
    scene.update_heap(heap(thing(x=0.62), stamp=2))
    assert found(scene, "o1") is None and found(scene, "o1_") is not None


@pytest.mark.parametrize(("place", "distance"), [
    ((0.5, 0.0), -0.02), ((0.5, 0.05), 0.03), ((0.56, 0.0), 0.03), ((0.53, 0.02), 0.0)])
def test_distance_to_an_outline_is_negative_inside(place, distance):
    assert distance_to(thing(), place) == pytest.approx(distance, abs=1e-9)


def test_object_without_an_outline_is_a_rectangle_along_its_yaw():
    seen = thing().model_copy(update={"outline": [], "yaw": np.pi / 2})
    assert np.ptp(prism(seen).outline, axis=0) == pytest.approx([0.04, 0.06])


def test_objects_cannot_take_the_id_of_a_fixture_a_foreign_body_or_another_object(world):
    scene = SortingScene(world, "tool")
    body = Foreign(center=Vector3(x=0.4, z=0.3), size=Vector3(x=0.1, y=0.1, z=0.2))
    scene.update_heap(heap(thing("table"), thing("foreign_1", 0.4), thing("a", 0.6), thing("a", 0.7), foreign=[body]))
    solids = scene.scene().objects
    assert len({each.id for each in solids}) == len(solids), "else fingers that may touch a target may touch the table"
    assert [each.id for each in solids if each.kind == "foreign"] == ["foreign_1"]
    assert sum(each.role == "target" and not each.kind for each in solids) == 4


@pytest.mark.parametrize(("field", "value"), [
    ("size", {"x": -1e9, "y": 0.0, "z": 0.0}), ("size", {"x": 1e9, "y": 0.0, "z": 0.0}), ("top", 1e9),
    ("bottom", -1e9), ("volume", -1.0), ("outline", [(1e12, 0.0), (0.0, 1e12), (-1e12, 0.0)])])
def test_messages_have_no_objects_of_impossible_size(field, value):
    with pytest.raises(ValidationError):
        SeenObject.model_validate({**thing().model_dump(), field: value})
