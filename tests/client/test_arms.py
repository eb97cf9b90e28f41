"""A program in a cell with several arms: each is moved, held and asked by its name."""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from common.client.cell import Cell
from common.client.several_arms import arm_names, chosen_arm
from common.client.subscriptions import NothingReceived
from common.errors import ConfigError, UnknownName
from tests.client.simulated_cell import run

CELL = str(Path(__file__).parents[1] / "data" / "two_arms.yaml")


def test_each_arm_moves_by_its_name_and_the_other_one_stays() -> None:
    async def program(cell: Cell) -> None:
        left, right = cell.arms["left"], cell.arms["right"]
        assert left is cell.arms["left"] and await arm_names(cell.bus) == ["left", "right"]
        assert [name async for name in cell.arms] == ["left", "right"]
        before = await right.joints()
        aside = (await left.joints()) + np.array([0.3, 0, 0, 0, 0, 0, 0])
        await left.move(aside)
        assert np.allclose(await left.joints(), aside, atol=1e-3)
        assert np.array_equal(await right.joints(), before)
        await right.move("home")

    run(program, CELL)


def test_request_without_an_arm_and_unknown_arm_are_one_line_with_the_choices() -> None:
    async def program(cell: Cell) -> None:
        with pytest.raises(UnknownName, match=r"unknown arm 'lef' .did you mean 'left'.*choices: left, right"):
            async with chosen_arm(cell.bus, "lef"):
                pass
        with pytest.raises(ConfigError, match="--arm: is missing: two_arms has the arms left, right"):
            async with chosen_arm(cell.bus, ""):
                raise NothingReceived("two_arms/joint_states")

    run(program, CELL)


def test_stop_that_names_no_arm_stops_both_until_a_start_that_knew_it() -> None:
    async def stopped(cell: Cell) -> list[bool]:
        return [bool((await cell.arms[name].status()).stopped) for name in ("left", "right")]

    async def program(cell: Cell) -> None:
        await cell.task.stop()
        assert await stopped(cell) == [True, True]
        await cell.call("motion/stop")  # of an unknown operator
        seen = (await cell.arms["left"].status()).newest
        await cell.call("motion/stop", reason="intruder")
        await asyncio.sleep(0.1)  # virtual: the task has received it
        answer = await cell.call("task/command", command="start", acknowledged=seen)
        assert answer.message.count("by operator (intruder): start to go on") == 2  # of each arm
        assert await stopped(cell) == [True, True]
        await cell.task.start()
        assert await stopped(cell) == [False, False]

    run(program, CELL)
