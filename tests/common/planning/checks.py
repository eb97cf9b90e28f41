"""Pipelines of the tests, and checks of their responses."""

import numpy as np

from common.config import Pipeline
from common.messages import PlanningScene, PlanRequest, PlanResponse
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Cancel
from common.planning.trajectory import TimedPath, timed_path
from common.planning.validation import fine_samples
from tests.common.planning.scenes import CELL, ROBOT, UR5

PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
UR5_PIPELINE = PlanningPipeline(UR5, CELL.motion, CELL.pipeline)
CANCELLED = Cancel()
CANCELLED.set()


def with_planner(name: str, **options: object) -> PlanningPipeline:
    entries = [{"name": name, "options": options}]
    return PlanningPipeline(ROBOT, CELL.motion, Pipeline.model_validate({"planners": entries}))


def last(response: PlanResponse) -> np.ndarray:
    assert response.ok, response.message
    return np.array(response.trajectory.points[-1].positions)


def seconds(response: PlanResponse) -> float:
    """Duration of the trajectory."""
    assert response.ok, response.message
    return response.trajectory.points[-1].time_from_start


def is_free(pipeline: PlanningPipeline, request: PlanRequest, of: PlanningScene, response: PlanResponse) -> bool:
    """Whether the trajectory is free in a separate world, at a finer step, under the request's rules."""
    assert response.ok, response.message
    world = pipeline.world(request, of, request.start)
    path, _ = fine_samples(timed_path(response.trajectory), 0.005)
    return not any(world.collides(q) for q in path)


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
    assert all(ROBOT.within_limits(q) for q in fine_samples(trajectory, 0.005)[0])
    assert is_free(pipeline, request, of, response)
    assert response.attempts[-1].error == ""
    return trajectory


def planned(pipeline: PlanningPipeline, request: PlanRequest, of: PlanningScene) -> TimedPath:
    """Return the sound trajectory of a request."""
    return assert_sound(pipeline, request, of, pipeline.plan(request, of))


def assert_refused(response: PlanResponse, code: str, text: str) -> None:
    """A refusal has a code and a one-line reason, and no trajectory."""
    assert (response.ok, response.error, response.trajectory) == (False, code, None)
    assert text in response.message and "\n" not in response.message


def tool_places(timed: TimedPath, step: float = 0.003) -> np.ndarray:
    """Places of the tool (N, 3) [m] along a trajectory."""
    return np.array([ROBOT.fk(q)[:3, 3] for q in fine_samples(timed, step)[0]])
