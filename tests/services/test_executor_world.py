"""The simulated world behind the executor: laid out, edited, grasped, and found again."""

import asyncio

import numpy as np
import pytest

from common import topics
from common.config import load_cell
from common.errors import ConfigError, RemoteError
from common.kept_file import STATE_VARIABLE
from common.messages import (
    Vector3,
    WorldEdit,
)
from common.planning.ik import solve_ik
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.scene.workspace import unreachable_reason
from common.sim.interface import StandingObject
from common.sim.kinematic import KinematicWorld
from common.sim.standing import Standing, StateFile, state_file
from tests.services.executor_person import CELL, blocked, executor, goes_on, move


@pytest.mark.parametrize("backend", ["mock", "lag"])
async def test_ball_is_picked_up_and_dropped_into_the_box(robot: RobotModel, backend: str) -> None:
    home = robot.named("home")
    above, at, over = (solve_ik(robot, tool_down(*place), home) for place in
                       ((0.5, 0.0, 0.15), (0.5, 0.0, 0.03), (0.55, 0.25, 0.25)))
    async with executor(f"robot.hardware.backend={backend}", "world.balls=[[0.5, 0.0]]") as person:
        assert (await person.follow("1", move(robot, home, above))).state == "succeeded"
        assert (await person.follow("2", move(robot, above, at))).state == "succeeded"
        closed = await person.grip("3", 0.0)
        assert closed.holding and closed.width == pytest.approx(0.06)
        assert (await person.follow("4", move(robot, at, above))).state == "succeeded"
        assert (await person.follow("5", move(robot, above, over))).state == "succeeded"
        assert (await person.see(person.balls, lambda b: b.labels == ["held"])).poses[0].position.z > 0.1
        assert not (await person.grip("6", 0.08)).holding
        dropped = await person.see(person.balls, lambda b: b.labels == ["box"])
        assert dropped.poses[0].position.z == pytest.approx(0.035)
        assert [(await person.updates.next()).data for _ in range(2)] == ["remove:ball_1", "add:ball_1"]


async def test_world_edits_show_in_the_truth_and_bad_ones_are_refused() -> None:
    async with executor("world.count=2") as person:
        reply = await person.edit.call(WorldEdit(op="add", position=Vector3(x=0.4, y=0.2)))
        assert reply.id == "ball_3" and reply.ids == ["ball_1", "ball_2", "ball_3"]
        await person.see(person.balls, lambda b: len(b.ids) == 3)
        with pytest.raises(RemoteError) as refusal:
            await person.edit.call(WorldEdit(op="remove", id="ball_9"))
        assert refusal.value.code == "unknown_id" and "ball_3" in refusal.value.message
        await person.edit.call(WorldEdit(op="remove", id="ball_3"))
        await person.see(person.balls, lambda b: len(b.ids) == 2)


async def test_impossible_layout_stops_it_with_the_place() -> None:
    with pytest.raises(ConfigError, match=r"world\.objects: cannot be placed: ball_1"):
        async with executor("world.balls=[[0.55, 0.17]]"):
            pass


async def test_random_layout_follows_the_seed_and_is_within_reach() -> None:
    seen = []
    for _ in range(2):  # one after the other: they are one cell
        async with executor("world.layout=random", "seed=4") as person:
            seen.append(await person.see(person.balls, lambda b: True))
    one, two = seen
    assert one.poses == two.poses and len(one.ids) == 7
    assert all(0.18 <= np.hypot(p.position.x, p.position.y) <= 0.82 for p in one.poses)


async def test_random_layout_keeps_to_the_limits_of_reach_of_the_cells_own_services() -> None:
    limits = ("services.workspace_validator.max_radius=0.52", "services.workspace_validator.min_radius=0.3")
    async with executor("world.layout=random", "world.count=4", *limits) as person:
        seen = await person.see(person.balls, lambda b: True)
    assert all(0.3 <= np.hypot(p.position.x, p.position.y) <= 0.52 for p in seen.poses) and len(seen.poses) == 4
    with pytest.raises(ConfigError, match=r"services\.workspace_validator\.max_radius: -3"):
        async with executor("world.layout=random", "services.workspace_validator.max_radius=-3"):
            pass


@pytest.mark.parametrize("off", [-0.005, 0.005])
async def test_random_layout_is_within_reach_also_when_seen_a_few_millimetres_off(off: float) -> None:
    cell = load_cell("panda")
    robot = RobotModel.load(cell.robot)
    async with executor("world.layout=random", "seed=20", "world.count=8") as person:
        seen = await person.see(person.balls, lambda b: True)
    for p in (pose.position for pose in seen.poses):
        radius = float(np.hypot(p.x, p.y))
        assert not unreachable_reason(robot, (p.x * (1 + off / radius), p.y * (1 + off / radius), p.z), cell.grasp)


# --- what is simulated survives the process that simulates it ---


async def test_started_again_with_a_ball_in_the_hand_it_finds_arm_fingers_and_ball_as_they_were(
    robot: RobotModel, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    home, world = robot.named("home"), load_cell("panda").world
    x, y = world.spots[3]
    above = solve_ik(robot, tool_down(x, y, 0.2), home)
    at_ball = solve_ik(robot, tool_down(x, y, world.ball_radius), above)
    async with executor() as person:
        await person.follow("a", move(robot, home, above))
        await person.follow("b", move(robot, above, at_ball))
        assert (await person.grip("close", 0.0)).holding
        await person.follow("c", move(robot, at_ball, above))
        before = await person.see(person.balls, lambda b: "held" in b.labels)
        joints = await person.see(person.joints, lambda _: True)
        gripper = person.gripper.latest
    async with executor() as person:
        found = await person.see(person.joints, lambda _: True)
        assert found.position == pytest.approx(joints.position, abs=1e-3)
        again = await person.see(person.gripper, lambda _: True)
        assert again.holding and again.width == pytest.approx(gripper.width) and again.state == "none"
        balls = await person.see(person.balls, lambda _: True)
        assert dict(zip(balls.ids, balls.labels, strict=True)) == dict(zip(before.ids, before.labels, strict=True))
        await person.follow("d", move(robot, above, home))
        held = balls.ids[balls.labels.index("held")]
        await person.grip("open", 0.08)
        balls = await person.see(person.balls, lambda b: b.labels[b.ids.index(held)] == "table")
        assert len(balls.ids) == len(before.ids)


async def test_what_was_kept_of_another_layout_is_not_used_nor_told_of(
    robot: RobotModel, tmp_path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    home = robot.named("home")
    caplog.set_level("INFO")
    async with executor() as person:
        await person.follow("a", move(robot, home, home + 0.2))
    async with executor("world.balls=[[0.5, 0.0]]") as person:
        assert len((await person.see(person.balls, lambda _: True)).ids) == 1
        found = await person.see(person.joints, lambda _: True)
        assert found.position[: robot.dof] == pytest.approx(home)
    assert "as they were" not in caplog.text
    async with executor("world.balls=[[0.5, 0.0]]"):
        assert "as they were" in caplog.text


async def test_what_one_simulator_kept_is_not_used_by_another(
    robot: RobotModel, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    home, world = robot.named("home"), load_cell("panda").world
    layout = KinematicWorld(world).layout
    falling = {name: StandingObject(pose=(*place, 0, 0, 0, 1), details={  # as physics has it: nobody knows where to
        "state": "falling", "container": "", "slot": None, "grip": None, "width": 0.0, "dropped": 0.0, "since": 0.0,
        "added": False, "rest": None}) for name, place in layout.items()}
    file = state_file(CELL)
    assert file is not None
    file.save(Standing(simulator="mujoco", layout=layout, q=(home + 0.2).tolist(), objects=falling))
    async with executor() as person:
        assert set((await person.see(person.balls, lambda _: True)).labels) == {"table"}
        found = await person.see(person.joints, lambda _: True)
        assert found.position[: robot.dof] == pytest.approx(home)


async def test_joint_states_go_on_while_a_place_is_looked_for_in_the_world(monkeypatch) -> None:
    box = WorldEdit(op="add", shape="box", size=Vector3(x=0.02, y=0.02, z=0.02), position=Vector3(x=0.35, y=-0.4))
    async with executor() as person:
        async with blocked(monkeypatch, KinematicWorld, "edit") as editing:
            asked = asyncio.create_task(person.edit.call(box, timeout=60))
            await editing.wait()
            await goes_on(person)
        assert (await asked).id == "box_1"
        objects = person.bus.reader(topics.SCENE_OBJECTS)
        await person.see(objects, lambda seen: "box_1" in [thing.id for thing in seen.objects])


async def test_joint_states_go_on_while_the_disk_is_stuck_on_which_the_simulated_world_is_kept(
    robot: RobotModel, monkeypatch, tmp_path
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    home = robot.named("home")
    async with executor() as person, blocked(monkeypatch, StateFile, "save") as saving:
        await person.execute.call(person.asks(id="1", trajectory=move(robot, home, home + 0.1)))
        await saving.wait()
        done = await person.see(person.motion, lambda m: m.id == "1" and m.state != "active")
        assert done.state == "succeeded"
        await goes_on(person)
    async with executor() as person:
        assert np.allclose((await person.joints.next()).position[:7], home + 0.1, atol=2e-3), "the newest was kept"
