"""Stages of force motions in the engine: planned from where the tool is, sent as requests, and what follows them."""

from __future__ import annotations

from typing import Any

import pytest

from common import messages as m
from common.errors import ConfigError
from common.tasks.engine import Task
from common.tasks.force import Comply, Insert, MoveUntil
from common.tasks.stages import Move, View
from tests.common.tasks.engine_cell import THERE, stops
from tests.common.tasks.engine_cell import Cell as EngineCell


class Cell(EngineCell):
    """A task that works through these stages once."""

    def __init__(self, *stages: Any) -> None:
        class Sequence(Task[View]):
            def decide(self, view: View) -> None:
                if not self.status.done:
                    self.queue += stages
                    self.status.done = 1

        super().__init__(Sequence)

    def of(self, kind: type[m.Message]) -> list[Any]:
        return [each for each in self.requests if type(each) is kind]


def test_line_is_planned_from_where_the_tool_is_once_the_motion_before_has_ended() -> None:
    touch = MoveUntil("touch", "PLACING", force=8.0, max_distance=0.03, touches=[("part", "table")],
                      fields={"speed": 0.02})
    cell = Cell(Move("reach", "REACHING", goal=THERE), touch, Move("up", "HOMING", goal=THERE))
    cell.until("reach")
    assert [each.stage for each in cell.of(m.PlanRequest)] == ["reach"], "nothing ahead of the force motion"
    cell.finish()
    cell.steps(3)
    line = cell.of(m.PlanRequest)[1]
    assert (line.stage, line.straight, line.start, line.allowed_collisions) == ("touch", True, [], [("part", "table")])
    at = line.goal.pose.position
    assert (at.x, at.y, at.z) == pytest.approx((0.3, 0.0, 0.2 - 0.031))
    (request,) = cell.of(m.ForceMotion)
    assert (request.kind, request.force, request.max_distance, request.speed) == ("until", 8.0, 0.03, 0.02)
    assert request.trajectory.points and request.plan == line.id and request.scene_stamp == 7
    cell.steps(5)
    assert len(cell.of(m.PlanRequest)) == 2 and cell.stage == "touch", "its end is not known before"
    cell.finish()
    cell.until("up")
    assert cell.of(m.PlanRequest)[2].stage == "up"


def test_failed_force_motion_is_a_failure_of_its_stage_with_the_reason() -> None:
    cell = Cell(Insert("insert", "PLACING", fields={"depth": 0.01}))
    cell.until("insert")
    cell.arm("aborted", error="not_inserted", message="not inserted in 8 searches")
    cell.steps(2)
    assert cell.status.failures == 1 and cell.status.message.startswith("insert aborted: not inserted in 8 searches")


def test_force_motion_that_outlasts_its_timeout_is_stopped() -> None:
    cell = Cell(Comply("guide", "PLACING", force=0.0, fields={"timeout": 5.0}))
    cell.until("guide")
    goal = cell.motion.id
    stopped: list[str] = []
    while not stopped:
        stopped += stops(cell.step())
    assert stopped == [goal]


@pytest.mark.parametrize(("fields", "problem"), [
    ({"fields": {"depth": 0.2}}, "depth 0.2 must be less than max_distance 0.05"),
    ({"fields": {"spiral": 1}}, "spiral"),
    ({"force": -1.0}, "force"),
    ({"direction": (0.0, 0.0, 2.0)}, "direction has length 2, it must be 1"),
])
def test_invalid_stage_is_one_line(fields: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        Insert("insert", "PLACING", **fields)
