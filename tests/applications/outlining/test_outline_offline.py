"""From a rendered picture and its depth to planned motions, without a cell."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from applications.outlining.contours import ContourOptions
from applications.outlining.offline import OutlineError, Perceived, perceive, plan_outline
from applications.outlining.recording import distances
from applications.outlining.solids import planning_scene
from applications.outlining.task import MotionSegments, TracingParameters
from applications.outlining.top_face import TopFaceOptions
from applications.outlining.topics import OutlineSelect
from common import messages as m
from common.config import Cell, ObjectConfig, Surroundings, load_cell
from common.perception.depth import DepthError
from common.perception.pinhole import Pinhole
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel
from common.sim.objects import world_object
from common.sim.rendering import Renderer

CELL = load_cell("ur5")
AROUND = CELL.section(Surroundings)
assert isinstance(AROUND, Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
TALL = ObjectConfig(id="tower", shape="box", x=0.5, y=0.0, z=1.0, size=(0.04, 0.04), height=1.2)


@cache
def view() -> Renderer:
    return Renderer(AROUND, RobotModel.load(CELL.robot))


@cache
def pipeline() -> PlanningPipeline:
    return PlanningPipeline(RobotModel.load(CELL.robot), CELL.motion, CELL.pipeline)


def photographed(objects: list[ObjectConfig]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    state = m.JointState(header=m.Header(), name=CELL.robot.joints, position=CELL.robot.named_poses["home"])
    seen = view().render([world_object(thing) for thing in objects], state)
    return seen.colour, seen.depth_within(0.10, 2.25)


def perceived(objects: list[ObjectConfig], select: OutlineSelect | None = None) -> Perceived:
    colour, depth = photographed(objects)
    return perceive(colour, depth, CAMERA, select or OutlineSelect(), ContourOptions(), TopFaceOptions(), 5e-5)


def planned(found: Perceived, *, given: bool = False, **parameters: float) -> list[tuple[str, m.PlanResponse]]:
    assert CELL.robot.gripper is not None
    legs = MotionSegments(TracingParameters(**parameters), CELL.robot.gripper)
    scene = planning_scene(AROUND, found.solids, 1)
    motions = plan_outline(pipeline(), legs, found.cleared, found.label, scene, given=given)
    return [(leg.name, response) for leg, response in motions]


def world(name: str) -> Cell:
    return load_cell("ur5", world=name)


@pytest.mark.parametrize("name", ["w1", "w2", "w3", "w4", "w5", "w6"])
def test_every_world_is_planned_from_image_to_last_motion(name: str) -> None:
    objects = list(world(name).world.objects)
    found = perceived(objects)
    truth = [world_object(thing) for thing in objects]
    tops = [np.column_stack([np.array(t.outline), np.full(len(t.outline), t.base + t.height)]) for t in truth]
    assert min(float(distances(found.cleared, top).max()) for top in tops) < 5e-4
    motions = planned(found)
    assert [name for name, _ in motions] == ["approach", "descend", "trace", "retreat", "home"]
    assert all(response.ok for _, response in motions)
    assert dict(motions)["trace"].fraction == 1.0


def test_object_out_of_reach_is_named_with_the_reason() -> None:
    with pytest.raises(OutlineError, match=r"Object_0: approach: .*reach"):
        planned(perceived([TALL]))


def test_image_without_an_object_has_no_outline() -> None:
    with pytest.raises(OutlineError, match="no contour"):
        perceived([])


def test_unknown_contour_is_rejected_with_the_choices() -> None:
    with pytest.raises(OutlineError, match=r"no contour 7; choices: 0 \(Object_0, yellow\)"):
        perceived(list(CELL.world.objects), OutlineSelect(rule="index", index=7))


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
