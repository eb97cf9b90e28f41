"""Solids that an operator adds, in a simulated cell on the virtual clock."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from common import topics
from common.client.cell import Cell
from common.client.goals import pose
from common.client.operator_motion import MotionFailed
from common.errors import ConfigError, RemoteError
from lab.simulation import Simulation
from tests.client.simulated_cell import run, run_with_processes
from tests.harness import until
from tests.simulated.test_interlocks import again

pytestmark = pytest.mark.timeout(600)

LEFT, RIGHT = pose(0.45, 0.25, 0.35), pose(0.45, -0.25, 0.35)
WALL = ("box", (0.3, 0.02, 0.7))  # between them


@pytest.mark.slow
def test_added_solid_is_avoided_also_after_a_restart_until_it_is_removed() -> None:
    async def program(simulated: Simulation, cell: Cell) -> None:
        await cell.arm.move(LEFT)
        free = await cell.arm.plan(RIGHT, straight=True)
        for _ in range(2):  # also if it is added again
            assert await cell.scene.add("wall", *WALL, at=(0.45, 0.0, 0.35)) == "added/wall"
        (wall,) = await cell.scene.objects()
        assert (wall.id, wall.shape, wall.dimensions) == ("added/wall", WALL[0], list(WALL[1]))
        assert wall.pose.position.x == 0.45
        assert "added/wall" not in [each.id for each in await cell.objects()], "it is not perceived"
        with pytest.raises(MotionFailed, match="added/wall"):
            await cell.arm.plan(pose(0.45, 0.0, 0.35))
        with pytest.raises(RemoteError, match="another solid is called"):
            await cell.scene.add("wall", *WALL, at=(0.5, 0.0, 0.35))

        await again(simulated, cell.bus, "scene_manager")
        assert [each.id for each in await cell.scene.objects()] == ["added/wall"]
        with pytest.raises(MotionFailed, match="added/wall"):
            await cell.arm.plan(RIGHT, straight=True)
        around = await cell.arm.plan(RIGHT)
        assert around.duration > free.duration > 0
        await cell.arm.execute(around)

        assert await cell.scene.remove("wall") == [] == await cell.scene.objects()
        await cell.arm.move(LEFT)
        await cell.arm.move(RIGHT, straight=True)
        with pytest.raises(RemoteError, match="no added solid is called added/wall; there are: none"):
            await cell.scene.remove("wall")

    run_with_processes(program, "panda", "world.count=1")


def test_solid_added_on_the_path_of_a_motion_stops_the_arm_until_it_is_removed() -> None:
    async def program(cell: Cell) -> None:
        motion = cell.bus.reader(topics.MOTION_STATUS)
        await cell.arm.move(LEFT)
        moving = asyncio.create_task(cell.arm.move(RIGHT, straight=True, speed=0.2))
        await until(motion, lambda m: m.state == "active" and m.progress > 0.02)
        await cell.scene.add("wall", *WALL, at=(0.45, -0.1, 0.35))
        held = await until(motion, lambda m: "scene_monitor" in m.held_by and m.message.startswith("held"), 2.0)
        assert "added/wall obstructs" in held.message
        await cell.scene.remove("wall")
        assert (await moving).state == "succeeded"

    run(program, "panda", "world.count=1")


def test_invalid_solid_is_refused_in_one_line_and_perception_does_not_remove_a_valid_one() -> None:
    async def program(cell: Cell) -> None:
        for name, shape, dimensions, at, words in (
            ("a", "mesh", (1,), (0, 0, 0), "shape"), ("a", "box", (1,), (0, 0, 0), "3 dimensions"),
            ("a", "box", "big", (0, 0, 0), "dimensions: 'big' must be numbers"),
            ("a", "sphere", (0,), (0, 0, 0), "0.001"),
            ("a", "sphere", (1,), (0, 11, 0), "position.y 11"), ("a", "sphere", (1,), "here", "at: 'here'"),
            ("", "sphere", (1,), (0, 0, 0), "id"), ("a", "sphere", (np.nan,), (0, 0, 0), "finite"),
            ("a", "sphere", (1,), 2 * np.eye(4), "at"),
        ):
            with pytest.raises(ConfigError, match=words) as caught:
                await cell.scene.add(name, shape, dimensions, at)  # type: ignore[arg-type]
            assert "\n" not in str(caught.value)
        with pytest.raises(ConfigError, match="color"):
            await cell.scene.add("a", "sphere", (1,), (0, 0, 0), color=(2, 0, 0))
        assert await cell.scene.objects() == []
        await cell.scene.add("a", "sphere", (0.05,), (0.0, 0.6, 0.8))
        scenes = cell.bus.reader(topics.PLANNING_SCENE)
        seen = await until(scenes, lambda scene: any(each.role == "target" for each in scene.objects))
        assert "added/a" in [each.id for each in seen.objects]

    run(program, "ur5")
