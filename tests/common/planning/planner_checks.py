"""Checks of every planner's response, and the scenes in which all plan."""

from __future__ import annotations

import numpy as np

from common.config import Pipeline
from common.messages import PlanningScene, PlanRequest, PlanResponse
from common.planning.pipeline import PlanningPipeline
from common.planning.trajectory import TimedPath, timed_path
from common.planning.validation import fine_samples
from tests.common.planning.planning_scenes import CELL, ROBOT, SPREAD, above, scene, solid

AROUND = scene(SPREAD)
LEFT, RIGHT = above(0.5, 0.3, 0.2), above(0.5, -0.3, 0.2)


def with_planner(name: str, **options: object) -> PlanningPipeline:
    entries = [{"name": name, "options": options}]
    return PlanningPipeline(ROBOT, CELL.motion, Pipeline.model_validate({"planners": entries}))


def wall(height: float = 0.4, depth: float = 0.5) -> PlanningScene:
    """A wall across the table that blocks the straight edge between both sides."""
    extra = solid("wall", "fixture", "box", [depth, 0.02, height], (0.55, 0.0, height / 2))
    return AROUND.model_copy(update={"objects": [*scene(box=False).objects, extra]})


def assert_sound(
    pipeline: PlanningPipeline, request: PlanRequest, of: PlanningScene, response: PlanResponse
) -> TimedPath:
    """Return the trajectory: from the start, at rest at its ends, within limits and free at a finer step."""
    assert response.ok, response.message
    trajectory = timed_path(PlanResponse.model_validate(response.model_dump()).trajectory)
    scaling = request.velocity_scaling or CELL.motion.velocity_scaling
    assert (np.diff(trajectory.times) > 0).all()
    assert np.allclose(trajectory.positions[0], request.start, atol=1e-6)
    assert np.abs(trajectory.velocities[[0, -1]]).max() < 1e-9
    assert (np.abs(trajectory.velocities) <= scaling * ROBOT.velocity * 1.001).all()
    assert (np.abs(trajectory.accelerations) <= scaling * ROBOT.acceleration * 1.001).all()
    world = pipeline.world(request, of, request.start)
    path, _ = fine_samples(trajectory, 0.005)
    assert not any(world.collides(q) for q in path)
    assert all(ROBOT.within_limits(q) for q in path)
    assert response.attempts
    assert response.attempts[-1].error == ""
    return trajectory
