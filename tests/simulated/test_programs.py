"""Complete programs on the virtual clock."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from applications.programming.files import load_program
from applications.programming.offline import overrides_for
from applications.programming.topics import ProgramStatus
from common import messages as m
from common import topics
from common.client.cell import Cell
from common.errors import RemoteError
from common.transport.bus import Bus
from lab.simulation import Simulation
from tests.simulated.program_cell import Operator, simulate, until

BOXES = str(Path(__file__).parents[1] / "data" / "boxes.yaml")
TEND = """\
steps:
  - {step: move, to: home}
  - {step: output, signal: clamp}
  - {step: wait, for: {signal: clamp_closed}, timeout: 2}
  - step: loop
    count: 2
    steps:
      - {step: move, id: down, to: {by: [0, 0, -0.1]}, straight: true, requires: {clamp_closed: true}}
      - {step: retreat, id: up, distance: 0.1, axis: world}
  - step: if
    when: {signal: busy}
    then: [{step: wait, seconds: 60}]
    else:
      - {step: output, signal: start}
      - {step: wait, for: {signal: busy}}
      - {step: output, signal: start, value: false}
  - {step: call, program: finish}
"""
FINISH = """\
steps:
  - {step: wait, for: {signal: busy, value: false}, timeout: 5}
  - {step: output, signal: clamp, value: false}
  - {step: through, points: [{position: [0.5, 0.2, 0.5]}, {position: [0.5, -0.2, 0.5]}, home], blend: 0.05}
"""


def test_program_with_io_loops_conditions_and_a_call_runs_to_its_end(tmp_path: Path) -> None:
    (tmp_path / "tend.yaml").write_text(TEND)
    (tmp_path / "finish.yaml").write_text(FINISH)
    seen: list[str] = []

    async def visit(operator: Operator) -> None:
        await operator.send("run", program="tend")

        def note(status: object) -> bool:
            step = getattr(status, "step", "")
            if step and (not seen or seen[-1] != step):
                seen.append(step)
            return getattr(status, "state", "") in ("DONE", "ERROR")

        assert (await operator.until(note)).done == 13

    simulate(tmp_path, visit)
    assert seen == ["move1", "output1", "wait1", "down", "up", "down", "up", "output2", "wait3", "output3", "wait1",
                    "output1", "through1"]

LIFT = """\
steps:
  - {step: move, id: away, to: {position: [0.4, 0.0, 0.5]}, speed: 0.3}
  - step: loop
    count: 2
    steps:
      - {step: move, id: down, to: {by: [0, 0, -0.1]}, straight: true, speed: 0.1}
  - {step: move, id: up, to: {by: [0, 0, 0.1]}, straight: true}
"""


async def tool(bus: Bus) -> float:
    """Height of the tool [m]."""
    return float((await Cell.on(bus).arm.pose())[2, 3])


def test_killed_runner_halts_at_its_step_until_the_operator_resumes_it(tmp_path: Path) -> None:
    (tmp_path / "lift.yaml").write_text(LIFT)
    made: list[Simulation] = []
    heights: list[float] = []

    async def visit(operator: Operator) -> None:
        motion = operator.bus.reader(topics.MOTION_STATUS)
        await operator.send("run", program="lift")
        await operator.until(lambda status: status.repetitions == ["loop1: 2 of 2"])
        first = motion.latest
        assert first is not None
        await until(motion, lambda status: status.id != first.id and 0.2 < status.progress < 0.8)
        made[0].kill("program_runner")
        halted = await operator.until(lambda status: bool(status.halted))
        assert "lift was interrupted at step down" in halted.halted
        assert (halted.step, halted.repetitions, halted.done) == ("down", ["loop1: 2 of 2"], 2)
        await until(motion, lambda status: status.state != "active")
        at_rest = motion.latest
        await operator.send("breakpoint", step="up", enabled=False)  # a command that moves nothing
        await asyncio.sleep(5.0)
        assert motion.latest is not None and at_rest is not None and motion.latest.id == at_rest.id
        await operator.send("resume")
        await operator.until(lambda status: status.state == "DONE")
        heights.append(await tool(operator.bus))

    simulate(tmp_path, visit, made=made)
    assert heights == [pytest.approx(0.4, abs=0.002)], "the step that was repeated has ended where it began first"


def test_breakpoints_single_steps_and_a_run_from_a_step_halt_where_they_say(tmp_path: Path) -> None:
    (tmp_path / "lift.yaml").write_text(LIFT)
    (tmp_path / "other.yaml").write_text("steps: [{step: move, to: hom}]\n")

    async def visit(operator: Operator) -> None:
        await operator.send("breakpoint", program="lift", step="down")
        with pytest.raises(RemoteError, match="nothing to resume: lift was not started; run it"):
            await operator.send("resume")
        await operator.send("run")
        assert (await operator.until(lambda status: bool(status.halted))).halted == "breakpoint at down"
        await operator.send("step")
        assert (await operator.until(lambda status: status.done == 2)).repetitions == ["loop1: 2 of 2"]
        halted = await operator.until(lambda status: status.done == 2 and bool(status.halted))
        assert halted.halted == "single step: down is next"
        await operator.send("breakpoint", step="down", enabled=False)
        await operator.send("resume")
        assert (await operator.until(lambda status: status.state == "DONE")).done == 4
        for refused, fields in (("there is no program 'none'", {"command": "run", "program": "none"}),
                                ("unknown step 'x'", {"command": "run_from", "step": "x"}),
                                ("there is no step 'x'", {"command": "breakpoint", "step": "x"}),
                                ("nothing to resume: lift has ended", {"command": "resume"})):
            with pytest.raises(RemoteError, match=refused):
                await operator.send(**fields)
        await operator.send("run_from", step="up")
        with pytest.raises(RemoteError, match="lift is at step up"):
            await operator.send("run")
        assert (await operator.until(lambda status: status.state == "DONE" and status.done == 1)).program == "lift"
        await operator.send("run", program="other")
        failed = await operator.until(lambda status: status.state == "ERROR")
        assert failed.message.startswith("other.yaml:1: move1: unknown pose 'hom' (did you mean 'home'?)")
        await operator.send("run", program="lift")
        await operator.until(lambda status: status.state == "DONE")

    simulate(tmp_path, visit)


FUNCTIONS = """\
steps:
  - {step: python, id: fast, function: "own_functions_of_a_test:choose", arguments: {number: 3}}
  - {step: if, when: {outcome: odd}, then: [{step: wait, id: odd, seconds: 0.5}]}
  - {step: python, id: slow, function: "own_functions_of_a_test:slow", timeout: 0.5, on_failure: continue}
  - {step: if, when: {outcome: failed}, then: [{step: wait, id: failed, seconds: 0.5}]}
  - {step: python, id: wrong, function: "own_functions_of_a_test:wrong"}
"""
SOURCE = """\
import asyncio

def choose(number):
    return "odd" if number % 2 else "even"

async def slow():
    await asyncio.sleep(60)

def wrong():
    raise ValueError("no part")
"""


def test_functions_of_the_user_decide_time_out_and_fail(tmp_path: Path) -> None:
    (tmp_path / "call.yaml").write_text(FUNCTIONS)
    (tmp_path / "own_functions_of_a_test.py").write_text(SOURCE)
    steps: list[str] = []

    async def visit(operator: Operator) -> None:
        await operator.send("run", program="call")

        def note(status: ProgramStatus) -> bool:
            steps.append(status.step)
            return status.state == "ERROR"

        failed = await operator.until(note)
        assert failed.message == "call.yaml:6: wrong: own_functions_of_a_test:wrong raised ValueError: no part"
        assert failed.total == failed.done + 1, "the step that failed counts"

    simulate(tmp_path, visit, state="ERROR")
    assert list(dict.fromkeys(steps)) == ["fast", "odd", "slow", "failed", "wrong"]


SORT = """\
steps:
  - {step: move, to: home}
  - step: palletize
    pattern: {item: [0.05, 0.03, 0.03], columns: 2, gap: [0.05, 0.05], position: [0.45, -0.3, 0.0]}
    steps:
      - {step: pick, kind: box, role: target}
      - {step: move, to: home}
"""


@pytest.mark.slow
def test_objects_that_a_camera_sees_are_picked_and_placed_in_a_pattern(tmp_path: Path) -> None:
    (tmp_path / "sort.yaml").write_text(SORT)
    truth: list[m.WorldObjects] = []

    async def visit(operator: Operator) -> None:
        objects = operator.bus.reader(topics.SCENE_OBJECTS)
        await operator.send("run", program="sort")
        ended = await operator.until(lambda status: status.state in ("DONE", "ERROR"))
        assert (ended.state, ended.done) == ("DONE", 7), ended.message
        truth.append(await objects.next())

    file = load_program(tmp_path / "sort.yaml")
    simulate(tmp_path, visit, *overrides_for(file, BOXES)[0], cell=BOXES)
    places = sorted((round(each.pose.position.x, 2), round(each.pose.position.y, 2)) for each in truth[0].objects
                    if each.shape == "box")
    assert places == [(0.40, -0.30), (0.50, -0.30)]


TOUCH = """\
steps:
  - {step: move, to: {position: [0.5, 0.0, 0.10]}}
  - {step: grip, width: close}
  - {step: move, to: {position: [0.5, 0.0, 0.04]}, straight: true}
  - {step: until, force: 5, max_distance: 0.06, touch: [table]}
  - {step: retreat, distance: 0.05, axis: world, touch: [table]}
  - {step: until, id: air, force: 5, max_distance: 0.01, on_failure: continue}
"""


def test_step_until_contact_ends_at_the_table_in_physics_and_fails_in_the_air(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "touch.yaml").write_text(TOUCH)
    heights: list[float] = []

    async def visit(operator: Operator) -> None:
        await operator.send("run", program="touch")
        await operator.until(lambda status: status.step == "retreat1")
        heights.append(await tool(operator.bus))
        ended = await operator.until(lambda status: status.state in ("DONE", "ERROR"))
        assert (ended.state, ended.outcome, ended.retries) == ("DONE", "failed", 0), ended.message

    simulate(tmp_path, visit, "world.simulator=mujoco")
    assert abs(heights[0]) < 0.02, "the tips are at the height of the table"
