"""Processes that die at bad moments, and edits of the world during a run: every ball ends where it should."""

from __future__ import annotations

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS, SCENE_BALLS, PickPlaceStatus
from common import topics
from common.messages import GripperState, MotionStatus, PoseArray, Vector3, WorldEdit
from common.transport.bus import Bus
from tests.harness import until
from tests.simulated.visited import SimulatedCell

pytestmark = pytest.mark.timeout(600)  # some seconds of work, on a machine that may be busy


def holding(state: GripperState) -> bool:
    return state.holding


def empty(state: GripperState) -> bool:
    return not state.holding


def halfway(status: MotionStatus) -> bool:
    return status.state == "active" and status.progress > 0.3


@pytest.mark.slow
def test_task_and_scene_manager_are_killed_while_a_ball_is_held() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        gripper = bus.reader(topics.GRIPPER_STATE)
        for victim in ("smart_pick_place", "scene_manager"):
            await until(gripper, holding)
            cell.kill(victim)
            await until(gripper, empty)

    summary = SimulatedCell("panda", ["world.count=2"], visit=visit).summary
    assert summary["truth"] == {"in_box": 2, "on_table": 0, "elsewhere": 0, "containers": {"box": 2}}
    assert (summary["state"], summary["placed"]) == ("DONE", 2)
    assert summary["restarts"] == {"smart_pick_place": 1, "scene_manager": 1}


def test_motion_completes_though_the_router_is_lost() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        motion = bus.reader(topics.MOTION_STATUS)
        await until(bus.reader(topics.GRIPPER_STATE), holding)
        before = await until(motion, halfway)
        cell.lose_router(1.0)
        ended = await until(motion, lambda m: m.id != before.id or m.state != "active")
        assert (ended.id, ended.state) == (before.id, "succeeded")

    summary = SimulatedCell("panda", ["world.count=2"], visit=visit).summary
    assert summary["truth"] == {"in_box": 2, "on_table": 0, "elsewhere": 0, "containers": {"box": 2}}
    assert (summary["state"], summary["restarts"]) == ("DONE", {})


@pytest.mark.slow
def test_balls_that_are_moved_added_and_removed_end_in_the_box() -> None:
    def placing(status: PickPlaceStatus) -> bool:
        return status.state == "PLACING"

    def in_place(balls: PoseArray) -> bool:
        wanted = dict.fromkeys(["ball_1", "ball_2", "new"], "box")
        return dict(zip(balls.ids, balls.labels, strict=True)) == wanted

    async def visit(_cell: SimulatedCell, bus: Bus) -> None:
        edit = bus.client(topics.WORLD_EDIT)
        await until(bus.reader(PICK_PLACE_STATUS), placing)
        for change in (WorldEdit(op="move", id="ball_1", position=Vector3(x=0.50, y=-0.38)),
                       WorldEdit(op="add", id="new", position=Vector3(x=0.40, y=0.10)),
                       WorldEdit(op="remove", id="ball_3")):
            await edit.call(change)
        await until(bus.reader(SCENE_BALLS), in_place, 120)

    summary = SimulatedCell("panda", ["world.count=3"], visit=visit).summary
    assert summary["state"] == "DONE"
    assert summary["truth"] == {"in_box": 3, "on_table": 0, "elsewhere": 0, "containers": {"box": 3}}
    assert summary["rejected"] == []


@pytest.mark.slow
def test_unreachable_ball_is_reported_and_the_run_ends_done() -> None:
    places = {  # by how the reason begins
        "": [(0.40, -0.30), (0.52, -0.30), (0.62, -0.25), (0.40, -0.17), (0.52, -0.17), (0.64, -0.13), (0.40, -0.04)],
        "the container is full": [(0.52, -0.04)],
        "inside the container": [(0.55, 0.25)],
        "too far": [(0.72, 0.42)],
        "singularity column": [(0.07, 0.01)],
        "partly out of view": [(0.40, 0.47)],
    }
    balls = [list(place) for group in places.values() for place in group]
    camera = "world.camera.position=[0.39, 0.0, 0.85]"  # sees the column too
    summary = SimulatedCell("panda", [f"world.balls={balls}", camera]).summary
    assert summary["state"] == "DONE"
    assert summary["truth"] == {"in_box": 8, "on_table": 4, "elsewhere": 0, "containers": {"box": 8}}
    reasons = {place["reason"].partition(":")[0] for place in summary["rejected"]}
    assert reasons == set(places) - {"", "inside the container"}
    assert len(summary["rejected"]) == 4
