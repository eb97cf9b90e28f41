"""Prisms fill the hull of any outline."""

import math

import coal
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from common.messages import CollisionObject, PathGoal, PlanningScene, PlanRequest, Pose, Vector3
from common.planning.pipeline import PlanningPipeline
from common.planning.prism import convex_hull, is_line, prism
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.planning_scenes import CELL, FINGERS, ROBOT, WORLD, above

HEIGHT = 0.2
ANGLE = [(-0.05, -0.05), (0.05, -0.05), (0.05, -0.03), (-0.03, -0.03), (-0.03, 0.05), (-0.05, 0.05)]
points = st.lists(st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)), min_size=3, max_size=60)


def touches(solid: coal.CollisionGeometry, x: float, y: float, z: float, radius: float = 1e-4) -> bool:
    result = coal.CollisionResult()
    there = coal.Transform3s(np.eye(3), np.array([x, y, z]))
    coal.collide(solid, coal.Transform3s(), coal.Sphere(radius), there, coal.CollisionRequest(), result)
    return bool(result.isCollision())


@settings(max_examples=60, deadline=None)
@example([(0.0, 0.0), (0.0, 0.125), (3e-35, 0.0), (-0.125, 0.0)], 0.25)
@given(points, st.floats(0.01, 0.3))
def test_prism_contains_its_points_and_nothing_outside_its_hull(outline, length):
    assume(not is_line([(round(x, 3), round(y, 3)) for x, y in outline]))
    solid = prism(outline, length)
    hull = convex_hull(np.array(outline))
    for x, y in [*outline, *(np.mean(outline, axis=0),)]:
        assert touches(solid, x, y, 0.0) and touches(solid, x, y, 0.49 * length)
        assert not touches(solid, x, y, 0.5 * length + 1e-3)
    middle = hull.mean(axis=0)
    for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        out = np.array([b[1] - a[1], a[0] - b[0]]) / max(np.linalg.norm(b - a), 1e-12)
        assert (a - middle) @ out >= -1e-6  # anticlockwise
        if np.linalg.norm(b - a) > 1e-3:
            assert not touches(solid, *((a + b) / 2 + 1e-3 * out), 0.0)


@pytest.mark.parametrize("count", [3, 4, 5, 64, 255, 256, 360, 2000])
def test_number_of_corners_does_not_matter(count):
    angles = np.linspace(0, 2 * math.pi, count, endpoint=False)
    solid = prism([(0.05 * math.cos(a), 0.05 * math.sin(a)) for a in angles], 0.1)
    assert touches(solid, 0.049 * math.cos(math.pi / 3) if count > 10 else 0.0, 0.0, 0.0)
    assert touches(solid, 0.0495, 0.0, 0.0) and touches(solid, 0.0, 0.0, -0.0499)
    assert not touches(solid, 0.0505, 0.0, 0.0) and not touches(solid, 0.0, 0.0, 0.051)


def prism_object(name: str, outline, position, length: float = 0.1) -> CollisionObject:
    x, y, z = position
    return CollisionObject(id=name, role="target", shape="prism", dimensions=[length], outline=outline,
                           pose=Pose(position=Vector3(x=x, y=y, z=z)))


def along(*places: tuple[float, float]) -> PlanRequest:
    poses = [matrix_to_pose(tool_down(x, y, HEIGHT)) for x, y in places]
    return PlanRequest(id="1", start=list(above(*places[0], HEIGHT)), goal=PathGoal(waypoints=poses))


def test_prism_may_be_touched_by_allowed_links_only():
    pipeline = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
    around = PlanningScene(header=WORLD, objects=[prism_object("angle", ANGLE, (0.5, 0.0, 0.15))])
    inside = along((0.5, -0.01), (0.49, -0.01))  # in the hull of the angle, outside its two sides
    response = pipeline.plan(inside, around)
    assert response.error == "start_in_collision"
    assert response.colliding[1] == "angle"
    touching = [(link, "angle") for link in FINGERS]
    assert pipeline.plan(inside.model_copy(update={"allowed_collisions": touching}), around).ok
    assert pipeline.plan(along((0.5, 0.3), (0.45, 0.3)), around).ok


def test_prism_without_area_is_refused_with_its_name():
    pipeline = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
    line = prism_object("line", [(0, 0), (0.01, 0.01), (0.02, 0.02)], (0.5, 0.3, 0.1))
    response = pipeline.plan(along((0.5, 0.0), (0.45, 0.0)), PlanningScene(header=WORLD, objects=[line]))
    assert response.error == "bad_scene"
    assert "line: the 3 points of its outline lie on one line" in response.message
