"""A program that handles objects: killed in the middle of a pick or a place, rehearsed, edited."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from applications.programming.files import load_program
from applications.programming.offline import overrides_for
from common import messages as m
from common import topics
from lab.simulation import Simulation
from tests.simulated.program_cell import Operator, simulate

BOXES = str(Path(__file__).parents[1] / "data" / "boxes.yaml")
MOVE_BOX = """\
steps:
  - {step: move, to: home}
  - {step: pick, kind: box}
  - {step: place, at: {position: [0.45, -0.3, 0.02], rpy: [3.14159265, 0, 0.6]}}
  - {step: move, id: end, to: home}
"""


def in_boxes(folder: Path, text: str = MOVE_BOX) -> tuple[str, ...]:
    (folder / "box.yaml").write_text(text)
    return tuple(overrides_for(load_program(folder / "box.yaml"), BOXES)[0])


@pytest.mark.parametrize("stage", [
    "lift", "leave", *(pytest.param(stage, marks=pytest.mark.campaign) for stage in ("descend", "lower"))])
def test_runner_killed_while_it_handles_an_object_continues_with_it_on_request(tmp_path: Path, stage: str) -> None:
    made: list[Simulation] = []
    truth: list[m.WorldObjects] = []

    async def visit(operator: Operator) -> None:
        objects = operator.bus.reader(topics.SCENE_OBJECTS)
        await operator.send("run", program="box")
        await operator.until(lambda status: status.stage == stage)
        await asyncio.sleep(0.15)
        made[0].kill("program_runner")
        step = (await operator.until(lambda status: bool(status.halted))).step
        assert step == ("pick1" if stage in ("descend", "lift") else "place1")
        await asyncio.sleep(2.0)
        await operator.send("resume")
        ended = await operator.until(lambda status: status.state in ("DONE", "ERROR"))
        assert (ended.state, ended.done) == ("DONE", 4), ended.message
        truth.append(await objects.next())

    simulate(tmp_path, visit, *in_boxes(tmp_path), cell=BOXES, made=made)
    at = [(round(each.pose.position.x, 2), round(each.pose.position.y, 2)) for each in truth[0].objects]
    assert at.count((0.45, -0.30)) == 1


def test_dry_run_plans_with_what_is_seen_and_nothing_moves(tmp_path: Path) -> None:
    async def visit(operator: Operator) -> None:
        motion, shown = operator.bus.reader(topics.MOTION_STATUS), operator.bus.reader(topics.DISPLAY_TRAJECTORY)
        scenes = operator.bus.reader(topics.PLANNING_SCENE)
        while not any(each.role == "target" for each in (await scenes.next()).objects):
            pass
        await operator.send("dry_run", program="box")
        found = (await operator.until(lambda status: status.rehearsal.state in ("done", "failed"))).rehearsal
        assert (found.state, [each.step for each in found.steps]) == ("done", ["move1", "pick1", "place1", "end"])
        assert [(each.unknown, each.problem) for each in found.steps] == [("", "")] * 4
        assert found.seconds == pytest.approx(sum(each.seconds or 0.0 for each in found.steps))
        assert shown.latest is not None and (motion.latest or await motion.next()).state == "none"
        await operator.send("run")
        ended = await operator.until(lambda status: status.state == "DONE")
        assert ended.task_seconds == pytest.approx(found.seconds, rel=0.25), "without the time of the fingers' readings"

    simulate(tmp_path, visit, *in_boxes(tmp_path), cell=BOXES)
