"""Invalid arguments of a program's calls: one line that names the argument, and nothing moves."""

import math
from collections.abc import AsyncIterable, Awaitable
from typing import Any

from common.client.cell import Cell
from common.errors import ZencellError
from tests.client.simulated_cell import run

ROWS = {  # call: what the error begins with
    "arm.move_until(5.0, direction='down')": "direction: 'down' must be numbers",
    "arm.move_until(5.0, direction=None)": "direction: None must be",
    "arm.move_until(5.0, touch=None)": "touch: None must be a list",
    "arm.move_until(5.0, kind='insert')": "kind: 'insert' is set by the client",
    "arm.move_until(5.0, owner='someone')": "owner: 'someone' is set by the client",
    "arm.move_until(5.0, id='one')": "id: 'one' is set by the client",
    "arm.move_until(5.0, nonsense=1)": "until.nonsense: 1 is not a parameter; choices:",
    "arm.move_until(None)": "force: None",
    "arm.comply(None)": "timeout: None",
    "arm.insert(None)": "depth: None",
    "arm.insert(nan)": "depth: nan",
    "arm.insert('deep')": "depth: 'deep'",
    "arm.insert(0.5)": "insert.depth: 0.5",
    "arm.insert(-0.1)": "insert.depth: -0.1",
    "arm.plan('home', touch=5)": "touch: 5 must be a list",
    "arm.plan('home', touch='table', allowed_collisions=5)": "allowed_collisions: 5",
    "arm.plan('home', id='one')": "id: 'one' is set by the client",
    "arm.plan('home', planner=5)": "plan.planner: 5",
    "arm.move('home', timeout='long')": "timeout: 'long' must be more than 0",
    "arm.jog(joints='all')": "jog.joints: 'all'",
    "arm.jog(seconds=None)": "seconds: None must be more than 0 and at most 60 s",
    "arm.order('payload', 1.0, owner='someone')": "owner: 'someone' is set by the client",
    "arms[[]].status()": "arm: [] must be a text",
    "gripper.move(0.02, timeout=nan)": "timeout: nan",
    "gripper.close(width=0.02)": "width: 0.02 is set by the client",
    "task.start(override='perhaps')": "start.override: 'perhaps'",
    "task.ended('soon')": "timeout: 'soon'",
    "io.wait('x', timeout=None)": "timeout: None",
    "world.add(0.4, 0.1, op='remove')": "op: 'remove' is set by the client",
    "world.move('ball_1', 0.4, 0.1, position=1)": "position: 1 is set by the client",
    "param.set(5, 1)": "path: 5 must be a text",
    "param.update('all')": "values: 'all' must be a mapping",
    "param[None].get()": "path: None must be a text",
    "objects('many')": "least: 'many'",
    "objects(9, timeout='long')": "timeout: 'long'",
    "listen('joint_states', timeout='long')": "timeout: 'long'",
    "listen(5, plain=True)": "key: 5 must be a text",
    "camera(5).image()": "unknown camera 5",
    "tf(5, 'world')": "unknown frame 5",
}


def test_invalid_arguments_are_named_in_one_line() -> None:
    async def result_of(call: Awaitable[Any] | AsyncIterable[Any]) -> object:
        if isinstance(call, AsyncIterable):
            return await anext(aiter(call))
        return await call

    async def program(cell: Cell) -> None:
        before, wrong = await cell.arm.joints(), {}
        for call, expected in ROWS.items():
            try:
                found = repr(await result_of(eval(f"cell.{call}", {"cell": cell, "nan": math.nan})))
            except ZencellError as error:
                found = str(error)
            except Exception as error:
                found = repr(error)
            if expected not in found or "\n" in found:
                wrong[call] = found
        assert not wrong
        assert (await cell.arm.joints() == before).all()

    run(program, "panda", "world.count=1")
