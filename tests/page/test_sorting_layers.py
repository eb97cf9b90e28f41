"""Heap, objects, grasps and foreign bodies of sorting in the scene."""

import numpy as np
import pytest
import viser

from applications.sorting.fingers import finger_lines
from applications.sorting.page import counters
from applications.sorting.topics import HEAP, Foreign, GraspCandidate, Heap, Left, SeenObject, SortingStatus
from common import messages as m
from common import topics
from common.messages import Vector3
from common.perception.depth import point_cloud
from common.perception.pinhole import Pinhole
from common.robot.transforms import matrix_to_pose, tool_down
from tests.page.scene_cell import Stage, around_of

SQUARE = [(0.50, -0.02), (0.54, -0.02), (0.54, 0.02), (0.50, 0.02)]
CUP = SeenObject(id="object_1", center=Vector3(x=0.52, y=0.0, z=0.04), size=Vector3(x=0.04, y=0.04, z=0.05),
                 outline=SQUARE, top=0.05, color=m.Color(r=0.1, g=0.2, b=0.9))
BAR = CUP.model_copy(update={"id": "object_2", "center": Vector3(x=0.6, y=0.1, z=0.03)})


@pytest.fixture
def stage(server: viser.ViserServer) -> Stage:
    return Stage(server, "sorting")


def grasp(name: str = "g", *, proved: bool = True, score: float = 1.0) -> GraspCandidate:
    pose = matrix_to_pose(tool_down(0.5, 0.1, 0.03))
    return GraspCandidate(id=name, object="object_1", pose=pose, approach=pose, width=0.04, opening=0.06, score=score,
                 proved=proved)


def heap(**fields: object) -> Heap:
    return Heap.model_validate({"header": m.Header(stamp=1, frame_id="world"), "at_home": True, **fields})


def test_outline_and_name_are_drawn_on_top_of_each_object(stage: Stage) -> None:
    layer = stage.layer("objects")
    stage.say(HEAP, heap(objects=[CUP, BAR], left=[Left(object="object_2", reason="too wide")]))
    assert sorted(text for label in layer.labels.texts for text in label.split("\n")) == ["object_1", "object_2"]
    assert len(layer.nodes) == 2
    np.testing.assert_allclose(layer.nodes[0].points[:, 0, :2], SQUARE, atol=1e-6)
    np.testing.assert_allclose(layer.nodes[0].points[:, :, 2], 0.052, atol=1e-6)
    stage.say(HEAP, heap(objects=[CUP]).model_copy(update={"at_home": False, "objects": []}))
    assert len(layer.nodes) == 2, "away from home the arm may hide objects"
    stage.say(HEAP, heap(objects=[]))
    assert layer.nodes == [] and layer.labels.texts == []


def test_reason_is_shown_at_an_object_that_no_grasp_fits_but_not_while_it_waits_for_others(stage: Stage) -> None:
    layer = stage.layer("left_objects")
    waits = "not examined: better grasps of other objects came first"
    stage.say(HEAP, heap(objects=[CUP, BAR], left=[Left(object="object_2", reason="too wide"),
                                                   Left(object="object_1", reason=waits)]))
    assert layer.labels.texts == ["object_2: too wide"]
    stage.say(HEAP, heap(objects=[CUP, BAR]))
    assert layer.labels.texts == []


def test_proved_grasps_are_bright_and_thick_and_green_by_their_score(stage: Stage) -> None:
    layer = stage.layer("grasps")
    stage.say(HEAP, heap(grasps=[grasp("a"), grasp("b", score=0.0), grasp("c", proved=False)]))
    assert layer.nodes[True].thickness > layer.nodes[False].thickness
    assert layer.nodes[True].points.shape == (6, 2, 3) and layer.nodes[False].points.shape == (3, 2, 3)
    best, worst = layer.nodes[True].colors[0, 0].astype(int), layer.nodes[True].colors[3, 0].astype(int)
    assert best[1] > best[0] and worst[0] > worst[1]
    assert (layer.nodes[False].colors[0, 0].astype(int) < best / 2).all()
    stage.say(HEAP, heap())
    assert layer.nodes == {}


def test_fingers_are_drawn_along_the_closing_axis_above_the_tips() -> None:
    lines = finger_lines(grasp(), axis=1)
    np.testing.assert_allclose(lines[:2, 0, 2], 0.03, atol=1e-9)
    assert (lines[:2, 1, 2] > 0.06).all(), "the tool points down, so that fingers come from above"
    np.testing.assert_allclose(sorted(lines[:2, 0, 1]), [0.07, 0.13], atol=1e-9)
    np.testing.assert_allclose(sorted(finger_lines(grasp(), axis=0)[:2, 0, 0]), [0.47, 0.53], atol=1e-9)


def test_foreign_bodies_are_red_boxes_wherever_the_arm_is(stage: Stage) -> None:
    hand = Foreign(center=Vector3(x=0.4, y=0.2, z=0.1), size=Vector3(x=0.1, y=0.2, z=0.05))
    stage.say(HEAP, heap(foreign=[hand]).model_copy(update={"at_home": False}))
    (box,) = stage.layer("foreign_bodies").nodes
    assert box.dimensions == (0.1, 0.2, 0.05)
    np.testing.assert_allclose(box.position, [0.4, 0.2, 0.1])
    stage.say(HEAP, heap())
    assert stage.layer("foreign_bodies").nodes == []


def test_heap_shows_the_points_over_the_tray_only(stage: Stage) -> None:
    around = around_of("sorting")
    camera = Pinhole.from_config(around.camera)
    depth = np.full((camera.height, camera.width), 0.9, np.float32)
    header = m.Header(stamp=1, frame_id=around.camera.frame)
    stage.say(topics.DEPTH_CAMERA_POINTS, point_cloud(np.full((*depth.shape, 3), 90, np.uint8), depth, camera, header))
    node = stage.layer("points").nodes[topics.DEPTH_CAMERA_POINTS.key]
    world = node.points @ camera.T_world_optical[:3, :3].T + camera.position
    tray = around.containers["tray"]
    outside = np.abs(world[:, :2] - (tray.x, tray.y)).max(axis=1)
    assert 5_000 < len(world) <= 15_000 and outside.max() < tray.half_side + 0.02 + 1e-3


@pytest.mark.parametrize(("done", "attempts", "success"), [(0, 0, "–"), (3, 4, "75 %"), (5, 4, "100 %")])
def test_counters_report_tries_and_their_success(done: int, attempts: int, success: str) -> None:
    found = counters(SortingStatus(done=done, total=10, attempts=attempts, held="one"), 0)
    assert (found["sorted"], found["tries"], found["success"], found["last check"]) == (
        f"{done} of 10", attempts, success, "one")
