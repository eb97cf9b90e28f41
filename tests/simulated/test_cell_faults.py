"""Killed processes, bad messages and world edits in complete cells: every ball ends where it should."""

from typing import get_args

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS, SCENE_BALLS
from common import topics
from common.config import load_cell
from common.messages import MotionStatus, Vector3, WorldEdit
from common.supervision.wiring import owned_in, wiring_of
from common.transport.bus import Bus
from lab.chaos.agent import Chaos
from lab.chaos.plan import Fault, Form
from tests.harness import running_with, until
from tests.simulated.visited import SimulatedCell, in_box


def halfway(status: MotionStatus) -> bool:
    return status.state == "active" and status.progress > 0.3


@pytest.mark.slow
def test_arm_is_held_while_the_planner_is_down_and_then_resumes() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        motion, status = bus.reader(topics.MOTION_STATUS), bus.reader(PICK_PLACE_STATUS)
        before = await until(motion, halfway, 60)
        cell.kill("motion_planner")
        waiting = await until(status, lambda s: s.message == "the arm waits: motion_planner is gone", 20)
        held = await until(motion, lambda m: m.held, 20)
        assert held.held_by == ["watchdog"] and not waiting.paused
        assert held.id == before.id and "motion_planner is gone" in held.message
        ended = await until(motion, lambda m: not m.held and m.state != "active", 60)
        assert (ended.id, ended.state) == (before.id, "succeeded")

    summary = SimulatedCell("panda", ["world.count=1"], visit=visit).summary
    assert (summary["state"], summary["truth"], summary["failures"]) == ("DONE", in_box(1), 0)
    assert summary["restarts"] == {"motion_planner": 1}


@pytest.mark.slow
def test_task_and_scene_manager_are_killed_while_a_ball_is_held() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        gripper = bus.reader(topics.GRIPPER_STATE)
        for victim in ("smart_pick_place", "scene_manager"):
            await until(gripper, lambda state: state.holding)
            cell.kill(victim)
            await until(gripper, lambda state: not state.holding)

    summary = SimulatedCell("panda", ["world.count=2"], visit=visit).summary
    assert (summary["state"], summary["placed"], summary["truth"]) == ("DONE", 2, in_box(2))
    assert summary["restarts"] == {"smart_pick_place": 1, "scene_manager": 1}


def test_motion_completes_though_the_router_is_lost() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        motion = bus.reader(topics.MOTION_STATUS)
        await until(bus.reader(topics.GRIPPER_STATE), lambda state: state.holding)
        before = await until(motion, halfway)
        cell.lose_router(1.0)
        ended = await until(motion, lambda m: m.id != before.id or m.state != "active")
        assert (ended.id, ended.state) == (before.id, "succeeded")

    summary = SimulatedCell("panda", ["world.count=1"], visit=visit).summary
    assert (summary["state"], summary["truth"], summary["restarts"]) == ("DONE", in_box(1), {})


@pytest.mark.slow
def test_balls_that_are_moved_added_and_removed_end_in_the_box() -> None:
    async def visit(_cell: SimulatedCell, bus: Bus) -> None:
        edit = bus.client(topics.WORLD_EDIT)
        await until(bus.reader(PICK_PLACE_STATUS), lambda status: status.state == "PLACING")
        for change in (WorldEdit(op="move", id="ball_1", position=Vector3(x=0.50, y=-0.38)),
                       WorldEdit(op="add", id="new", position=Vector3(x=0.40, y=0.10)),
                       WorldEdit(op="remove", id="ball_3")):
            await edit.call(change)
        wanted = dict.fromkeys(["ball_1", "ball_2", "new"], "box")
        await until(bus.reader(SCENE_BALLS), lambda b: dict(zip(b.ids, b.labels, strict=True)) == wanted, 120)

    summary = SimulatedCell("panda", ["world.count=3"], visit=visit).summary
    assert (summary["state"], summary["truth"], summary["rejected"]) == ("DONE", in_box(3), [])


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
    assert summary["truth"] == {**in_box(8), "on_table": 4}
    reasons = {place["reason"].partition(":")[0] for place in summary["rejected"]}
    assert reasons == set(places) - {"", "inside the container"} and len(summary["rejected"]) == 4


@pytest.mark.slow
def test_bad_messages_stop_no_service_and_a_slipped_ball_is_grasped_again() -> None:
    happened: set[tuple[str, str]] = set()
    keys: list[str] = []

    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        whole = load_cell("panda", ["services.viewer.port=0"])
        keys[:] = owned_in({entry.name: await wiring_of(whole, entry) for entry in whole.services.values()})
        forms = [form for form in get_args(Form) if form not in ("", "huge")]
        bad = [Fault(0.0, "corrupt", key, form=form, count=2, seed=i) for i, key in enumerate(keys) for form in forms]
        bad += [Fault(0.0, "corrupt", key, form="huge") for key in (topics.GRIPPER_STATE.key, topics.JOINT_STATES.key)]
        old = [Fault(0.0, "replay", key, 0.5, count=3) for key in keys]
        chaos = Chaos(bus, [Fault(0.0, "drop"), *bad, *old], dict, cell.cell.world, slip_timeout=60)
        async with running_with(chaos.run()):
            await cell.ended.wait()
        happened.update((one.what, one.target) for one in chaos.injected)

    cell = SimulatedCell("panda", ["world.count=2"], visit=visit)
    assert (cell.summary["truth"], cell.summary["restarts"]) == (in_box(2), {})
    assert len({target for _, target in happened}) > len(keys) / 2
    assert "held object slips" in {what for what, _ in happened} and cell.summary["failures"] >= 1
    assert "refused a message of" in cell.text
