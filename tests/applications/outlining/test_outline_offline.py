"""From a rendered image and its depth to planned motions, without a cell."""

from functools import cache

import numpy as np
import pytest

from applications.outlining.contours import ContourOptions
from applications.outlining.offline import OutlineError, Perceived, perceive, plan_outline
from applications.outlining.recording import distances
from applications.outlining.solids import planning_scene
from applications.outlining.task import MotionSegments, TracingParameters
from applications.outlining.top_face import TopFaceOptions
from applications.outlining.topics import OutlineSelect
from common import messages as m
from common.config import ObjectConfig, Surroundings, load_cell
from common.perception.depth import DepthError
from common.perception.pinhole import Pinhole
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel
from common.sim.objects import world_object
from common.sim.rendering import Renderer

CELL = load_cell("ur5")
AROUND = CELL.section(Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
TALL = ObjectConfig(id="tower", shape="box", x=0.5, y=0.0, z=1.0, size=(0.04, 0.04), height=1.2)


@cache
def view() -> Renderer:
    return Renderer(AROUND, RobotModel.load(CELL.robot))


@cache
def pipeline() -> PlanningPipeline:
    return PlanningPipeline(RobotModel.load(CELL.robot), CELL.motion, CELL.pipeline)


def photographed(objects: list[ObjectConfig]):
    state = m.JointState(header=m.Header(), name=CELL.robot.joints, position=CELL.robot.named_poses["home"])
    seen = view().render([world_object(thing) for thing in objects], state)
    return seen.colour, seen.depth_within(0.10, 2.25)


def perceived(objects: list[ObjectConfig], select: OutlineSelect | None = None) -> Perceived:
    colour, depth = photographed(objects)
    return perceive(colour, depth, CAMERA, select or OutlineSelect(), ContourOptions(), TopFaceOptions(), 5e-5)


def planned(found: Perceived, *, given: bool = False, **parameters: float) -> list[tuple[str, m.PlanResponse]]:
    segments = MotionSegments(TracingParameters(**parameters), CELL.robot.gripper)
    scene = planning_scene(AROUND, found.solids, 1)
    motions = plan_outline(pipeline(), segments, found.cleared, found.label, scene, given=given)
    return [(segment.name, response) for segment, response in motions]


@pytest.mark.parametrize("name", ["w1", "w4", "w6", *(
    pytest.param(name, marks=pytest.mark.campaign) for name in ("w2", "w3", "w5"))])
def test_every_world_is_planned_from_image_to_last_motion(name: str) -> None:
    objects = list(load_cell("ur5", world=name).world.objects)
    found = perceived(objects)
    truth = [world_object(thing) for thing in objects]
    tops = [np.column_stack([np.array(t.outline), np.full(len(t.outline), t.base + t.height)]) for t in truth]
    assert min(float(distances(found.cleared, top).max()) for top in tops) < 5e-4
    motions = planned(found)
    assert [name for name, _ in motions] == ["approach", "descend", "trace", "retreat", "home"]
    assert all(response.ok for _, response in motions)
    assert dict(motions)["trace"].fraction == 1.0


@pytest.mark.parametrize(("objects", "select", "problem"), [
    ([TALL], OutlineSelect(), r"Object_0: approach: .*reach"),
    ([], OutlineSelect(), "no contour"),
    (CELL.world.objects, OutlineSelect(rule="index", index=7), r"no contour 7; choices: 0 \(Object_0, yellow\)"),
], ids=["out of reach", "no object", "no such object"])
def test_impossible_outline_is_rejected_with_the_reason(objects, select, problem) -> None:
    with pytest.raises(OutlineError, match=problem):
        planned(perceived(list(objects), select))


def test_empty_depth_image_is_rejected() -> None:
    colour, depth = photographed(list(CELL.world.objects))
    nothing = np.full_like(depth, np.nan)
    with pytest.raises(DepthError, match="no valid depth at all"):
        perceive(colour, nothing, CAMERA, OutlineSelect(), ContourOptions(), TopFaceOptions(), 5e-5)


def test_points_from_a_file_are_traced_anywhere() -> None:
    found = perceived(list(CELL.world.objects))
    moved = Perceived(found.label, found.contours, found.pixels, found.coordinates,
                      found.cleared + np.array([0.0, 0.15, 0.05]), found.solids)
    with pytest.raises(OutlineError, match="nothing in the planning scene"):
        planned(moved)
    assert len(planned(moved, given=True)) == 5
