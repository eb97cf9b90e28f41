"""Processes that die in the middle of a run, at the worst moments: the run ends DONE with every ball in the box."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from common import topics
from common.applications.pick_place.messages import PickPlaceStatus
from common.applications.pick_place.topics import PICK_PLACE_STATUS, SCENE_BALLS
from common.messages import GripperState, MotionStatus, PoseArray
from tests.harness import RunningCell, until

pytestmark = pytest.mark.cell


def holding(state: GripperState) -> bool:
    return state.holding


def empty(state: GripperState) -> bool:
    return not state.holding


@pytest.mark.slow
async def test_task_and_scene_manager_are_killed_with_a_ball_in_the_hand(tmp_path: Path) -> None:
    with RunningCell(tmp_path, "run", "panda", "--speed", "5", "--set", "world.count=3") as cell:
        async with cell.listen() as bus:
            gripper = bus.reader(topics.GRIPPER_STATE)
            for victim in ("smart_pick_place", "scene_manager"):
                await until(gripper, holding)
                before = cell.processes()[victim]
                before.kill()
                await until(gripper, empty)
            assert await cell.ended(90) == 0, cell.tail()
        summary = cell.summary
        assert not cell.processes()
    assert summary["truth"] == {"in_box": 3, "on_table": 0, "elsewhere": 0, "containers": {"box": 3}}
    assert (summary["state"], summary["placed"]) == ("DONE", 3)
    assert {name: n for name, n in summary["restarts"].items() if n} == {"smart_pick_place": 1, "scene_manager": 1}


async def test_the_router_is_killed_in_the_middle_of_a_motion(tmp_path: Path) -> None:
    def halfway(status: MotionStatus) -> bool:
        return status.state == "active" and status.progress > 0.3

    with RunningCell(tmp_path, "run", "panda", "--speed", "5", "--set", "world.count=2") as cell:
        async with cell.listen() as bus:
            await until(bus.reader(topics.GRIPPER_STATE), holding)
            await until(bus.reader(topics.MOTION_STATUS), halfway)
            cell.processes()["router"].kill()
            assert await cell.ended(90) == 0, cell.tail()
        summary = cell.summary
        assert not cell.processes()
    assert summary["truth"] == {"in_box": 2, "on_table": 0, "elsewhere": 0, "containers": {"box": 2}}
    assert summary["state"] == "DONE"
    assert {name: n for name, n in summary["restarts"].items() if n} == {"router": 1}


@pytest.mark.slow
async def test_balls_that_are_moved_added_and_taken_away_end_up_where_they_should(tmp_path: Path) -> None:
    def placing(status: PickPlaceStatus) -> bool:
        return status.state == "PLACING"

    def in_place(balls: PoseArray) -> bool:
        wanted = dict.fromkeys(["ball_1", "ball_2", "ball_4", "new"], "box")
        return dict(zip(balls.ids, balls.labels, strict=True)) == wanted

    # Not `run`: it may have ended before the last of these commands has found the cell.
    with RunningCell(tmp_path, "up", "panda", "--speed", "5", "--set", "world.count=4") as cell:
        async with cell.listen() as bus:
            task = bus.reader(PICK_PLACE_STATUS)
            await until(task, placing)
            for command in (("move", "ball_1", "0.50", "-0.38"), ("add", "0.40", "0.10", "--id", "new"),
                            ("remove", "ball_3")):
                answer = await asyncio.to_thread(cell.tell, "world", *command)
                assert answer.returncode == 0, answer.stderr
            await until(bus.reader(SCENE_BALLS), in_place)
            await until(task, lambda status: status.state == "DONE")
        cell.interrupt()
        assert await cell.ended(10) == 0
        summary = cell.summary
    assert summary["truth"] == {"in_box": 4, "on_table": 0, "elsewhere": 0, "containers": {"box": 4}}
    assert summary["rejected"] == []


@pytest.mark.slow
async def test_what_can_not_be_taken_is_reported_and_the_run_ends_done(tmp_path: Path) -> None:
    places = {  # by how the reason begins
        "": [(0.40, -0.30), (0.52, -0.30), (0.62, -0.25), (0.40, -0.17), (0.52, -0.17), (0.64, -0.13), (0.40, -0.04)],
        "the container is full": [(0.52, -0.04)],
        "inside the container": [(0.55, 0.25)],
        "too far": [(0.72, 0.42)],
        "singularity column": [(0.07, 0.01)],
        "partly out of view": [(0.40, 0.47)],
    }
    balls = [list(place) for group in places.values() for place in group]
    options = ["--speed", "10", "--set", f"world.balls={balls}"]
    options += ["--set", "world.camera.position=[0.39, 0.0, 0.85]"]  # sees the column too
    with RunningCell(tmp_path, "run", "panda", *options) as cell:
        assert await cell.ended(90) == 0, cell.tail()
        summary = cell.summary
    assert summary["state"] == "DONE"
    assert summary["truth"] == {"in_box": 8, "on_table": 4, "elsewhere": 0, "containers": {"box": 8}}
    told = {place["reason"].partition(":")[0] for place in summary["rejected"]}
    assert told == set(places) - {"", "inside the container"}
    assert len(summary["rejected"]) == 4
