"""A planner that dies while the arm moves: the arm is held on its path until it is back."""

from __future__ import annotations

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.messages import MotionStatus
from common.transport.bus import Bus
from tests.harness import until
from tests.simulated.visited import SimulatedCell

pytestmark = pytest.mark.timeout(600)  # some seconds of work, on a machine that may be busy


def under_way(status: MotionStatus) -> bool:
    return status.state == "active" and status.progress > 0.2


def test_arm_is_held_while_the_planner_is_down_and_then_resumes() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        motion, status = bus.reader(topics.MOTION_STATUS), bus.reader(PICK_PLACE_STATUS)
        before = await until(motion, under_way, 60)
        cell.kill("motion_planner")
        waiting = await until(status, lambda s: s.message == "the arm waits: motion_planner is gone", 20)
        held = await until(motion, lambda m: m.held, 20)
        assert held.held_by == ["watchdog"] and not waiting.paused
        assert held.id == before.id and "motion_planner is gone" in held.message
        ended = await until(motion, lambda m: not m.held and m.state != "active", 60)
        assert (ended.id, ended.state) == (before.id, "succeeded")

    summary = SimulatedCell("panda", ["world.count=1"], visit=visit).summary
    assert summary["state"] == "DONE"
    assert summary["truth"] == {"in_box": 1, "on_table": 0, "elsewhere": 0, "containers": {"box": 1}}
    assert (summary["failures"], summary["restarts"]) == (0, {"motion_planner": 1})
