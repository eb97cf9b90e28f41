"""The UR5 cell: detected, selected and edited outlines, and outlines that cannot be traced."""

import math
from pathlib import Path

import pytest

from applications.outlining import stage_files
from applications.outlining.contour_choice import parse_choice
from applications.outlining.topics import CONTOUR_PATH, CONTOURS, OUTLINE_SELECT
from applications.outlining.verbs import before_run
from common import topics
from common.messages import TaskCommand
from common.transport.bus import Bus
from tests.harness import until
from tests.simulated.outlined import assert_good
from tests.simulated.visited import SimulatedCell


@pytest.mark.slow
def test_selected_object_is_outlined() -> None:
    chosen: list[str] = []

    async def visit(_cell: SimulatedCell, bus: Bus) -> None:
        found = await until(bus.reader(CONTOURS), lambda found: len(found.contours) == 3)
        wanted = parse_choice("red")
        assert wanted is not None
        answer = await bus.client(OUTLINE_SELECT).call(wanted)
        assert answer.index != found.selected, "it is not the automatically selected one"
        chosen.append(answer.label)
        await until(bus.reader(CONTOUR_PATH), lambda path: path.object == chosen[0])
        await bus.client(topics.TASK_COMMAND).call(TaskCommand(command="start"))

    summary = SimulatedCell("ur5", ["autostart=false"], world="w5", visit=visit).summary
    assert_good(summary)
    outline = summary["outline"]
    assert outline["object"] == chosen[0] and outline["length_m"] == pytest.approx(2 * math.pi * 0.03, abs=0.005)


@pytest.mark.slow
def test_edited_coordinates_are_traced(tmp_path: Path) -> None:
    smaller = [[0.5 + dx, dy, 1.105] for dx, dy in ((-0.03, -0.03), (0.03, -0.03), (0.03, 0.03), (-0.03, 0.03))]
    stage_files.write_points(tmp_path / stage_files.CLEARED, smaller)
    overrides = before_run("ur5", [], None, source=str(tmp_path)).overrides  # of `run ur5 --from`
    outline = SimulatedCell("ur5", overrides).summary["outline"]
    assert outline["closed"] and outline["points"] == 4
    assert outline["length_m"] == pytest.approx(0.24)
    assert outline["tracking_mm"]["max"] < 0.15


def test_impossible_outline_ends_with_an_error_and_the_arm_at_home() -> None:
    tower = "{id: tower, shape: box, x: 0.5, y: 0.0, z: 1.0, size: [0.04, 0.04], height: 1.2}"
    cell = SimulatedCell("ur5", [f"world.objects=[{tower}]"])
    summary = cell.summary
    assert summary["state"] == "ERROR"
    assert summary["seconds"]["moving"] < 4  # cell time: the fingers at most
    assert summary["seconds"]["first_motion"] is None
    errors = [line for line in cell.lines if "  ERROR contour_tracer: " in line]
    assert len(errors) == 1 and "reach" in errors[0]
    assert "Traceback" not in cell.text
