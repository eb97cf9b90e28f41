"""Force motions of a program in a cell: refused without a sensor, until contact in physics, and obstructed lines."""

import asyncio

import pytest

from common import topics
from common.client.cell import Cell
from common.client.operator_motion import MotionFailed
from common.errors import ConfigError, UnknownName
from tests.client.simulated_cell import run
from tests.client.test_arm import pose


def test_cell_without_forces_refuses_and_bad_values_are_named() -> None:
    async def program(cell: Cell) -> None:
        with pytest.raises(MotionFailed, match="no force sensor") as failed:
            await cell.arm.move_until(5.0, max_distance=0.02)
        assert failed.value.code == "no_wrench"
        with pytest.raises(ConfigError, match=r"until\.force"):
            await cell.arm.move_until(-5.0)
        with pytest.raises(ConfigError, match="direction"):
            await cell.arm.comply(1.0, direction=(0.0, 0.0, 0.0))
        with pytest.raises(UnknownName, match="nothing"):
            await cell.arm.insert(0.01, touch=["nothing"])

    run(program, "panda", "world.count=1")


@pytest.mark.slow
def test_program_touches_the_table_and_its_end_ends_the_motion() -> None:
    pytest.importorskip("mujoco")

    async def program(cell: Cell) -> None:
        await cell.gripper.close()
        await cell.arm.move(pose(0.55, 0.0, 0.04))
        with pytest.raises(MotionFailed, match="table") as failed:
            await cell.arm.move_until(5.0, max_distance=0.06)
        assert failed.value.code in ("collision", "incomplete")
        found = await cell.arm.move_until(5.0, max_distance=0.06, touch=["table"])
        assert found.force >= 5.0 and 0.01 < found.distance < 0.05
        await cell.arm.move(pose(0.55, 0.0, 0.04), straight=True, touch=["table"])
        guiding = asyncio.create_task(cell.arm.comply(30.0, max_distance=0.01))
        async for status in cell.listen(topics.MOTION_STATUS):
            if status.state == "active":
                break
        guiding.cancel()
        async for status in cell.listen(topics.MOTION_STATUS):
            if status.state != "active":
                break
        assert status.state == "cancelled"

    run(program, "insertion", "autostart=false")
