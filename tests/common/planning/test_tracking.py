"""A moving target is met where it will be, at its velocity, within all limits, or not at all."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from common import messages as m
from common.config import load_cell
from common.control.trajectory import from_message
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, tool_down

CELL = load_cell("panda", ["motion.velocity_scaling=0.6", "motion.acceleration_scaling=0.6"])
ROBOT = RobotModel.load(CELL.robot)
PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
GRIPPER = CELL.robot.gripper
assert GRIPPER is not None
STAMP, BEGIN, DWELL = 99_800_000_000, 100_300_000_000, 0.5
Y = -0.4  # [m] of the target at STAMP


def plan(speed: float = 0.1, others: dict[str, float] | None = None, **goal: Any) -> m.PlanResponse:
    """Plan to a cube on a belt along y; `others` are positions of more cubes on it."""
    things = [m.CollisionObject(
        id=name, role="target", shape="box", dimensions=[0.04, 0.04, 0.04], velocity=m.Vector3(y=speed),
        pose=m.Pose(position=m.Vector3(x=0.5, y=y, z=0.08))) for name, y in {"target": Y, **(others or {})}.items()]
    scene = m.PlanningScene(header=m.Header(stamp=STAMP, frame_id="world"), objects=things)
    values = {"travel": 0.8, "dwell": DWELL, **goal}
    return PIPELINE.plan(m.PlanRequest(
        id="a", start=ROBOT.named("home").tolist(), gripper_width=0.06, planning_time=20.0,
        allowed_collisions=[(link, "target") for link in GRIPPER.links],
        goal=m.MovingGoal(pose=matrix_to_pose(tool_down(0.5, Y, 0.08)), stamp=STAMP, begin=BEGIN,
                          velocity=m.Vector3(y=speed), **values)), scene)


@pytest.mark.parametrize("speed", [0.0, 0.05, 0.2])
def test_tool_is_at_the_target_and_moves_with_it_while_it_stays(speed: float) -> None:
    response = plan(speed)
    assert response.ok, response.message
    assert response.trajectory is not None
    path = from_message(response.trajectory, tuple(ROBOT.joint_names))
    for time in np.linspace(response.meet_time, response.meet_time + DWELL, 20):
        since = (BEGIN - STAMP) * 1e-9 + time
        at = ROBOT.fk(path.at(float(time))[0])[:3, 3]
        assert at == pytest.approx([0.5, Y + speed * since, 0.08], abs=5e-4)
    assert (np.abs(path.velocities) <= 0.6 * ROBOT.velocity + 1e-6).all()
    assert ROBOT.fk(path.positions[-1])[2, 3] == pytest.approx(0.18, abs=1e-3)


@pytest.mark.parametrize(("goal", "error"), [
    ({"travel": 0.1}, "too_late"), ({"speed": 0.2, "travel": 0.3}, "too_late"),
    ({"others": {"b": Y - 0.041}}, "collision")])
def test_target_that_cannot_be_met_is_refused_with_the_reason(goal: dict[str, Any], error: str) -> None:
    response = plan(**goal)
    assert (response.ok, response.error) == (False, error), response.message


def test_object_that_moves_along_at_some_distance_is_no_obstacle_and_does_not_hold_the_motion() -> None:
    assert plan(others={"b": Y - 0.15, "c": Y + 0.15}).ok
