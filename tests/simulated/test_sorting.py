"""The sorting task with doubles of perception and planner: rules, what cannot be grasped, and faults."""

from pathlib import Path

import pytest

from common import topics
from common.config import Cell, load_cell
from common.messages import WorldObjects
from common.transport.codec import decode
from lab.doubles import settings_of, with_doubles
from lab.simulation import Outcome, Simulation

WORLD = str(Path(__file__).parents[1] / "data" / "tray_objects.yaml")
STATUS = "sorting_status"


class Observer:
    """Takes the place of a trace: the last ground truth and status, and all states of the task."""

    def __init__(self):
        self.truth, self.status, self.states = WorldObjects(), None, []

    def add(self, raw, _now):
        if raw.key.endswith(topics.SCENE_OBJECTS.key):
            self.truth = decode(WorldObjects, raw.payload)
        elif raw.key.endswith(STATUS):
            from applications.sorting.topics import SortingStatus

            self.status = decode(SortingStatus, raw.payload)
            self.states.append(self.status.state)

    @property
    def places(self) -> dict[str, str]:
        return {each.id: each.container or each.state for each in self.truth.objects}


def cell_of(*settings: str) -> Cell:
    return with_doubles(load_cell("sorting", [*settings_of("sorting"), *settings], world=WORLD))


def run(*settings: str, faults: bool = False, seed: int = 1) -> tuple[Outcome, Observer]:
    observer = Observer()
    return Simulation(cell_of(*settings), seed, faults=faults, trace=None if faults else observer).run(), observer


def test_tray_is_cleared_by_color_without_returning_home_between_objects():
    outcome, observer = run()
    assert (outcome.state, outcome.done, outcome.total, outcome.broken) == ("DONE", 3, 3, []), outcome
    assert observer.places == {"red_box": "left", "blue_can": "right", "green_bar": "right"}
    assert observer.states.count("HOMING") < 3 * observer.states.count("CHECKING")
    assert observer.status.figures["success_rate"] == 1.0 and observer.status.figures["picks_per_hour"] > 400


def test_rule_decides_the_container():
    outcome, observer = run("services.sorter={by: color, where: {green: left, red: right}}")
    assert outcome.state == "DONE" and not outcome.broken, outcome
    assert observer.places == {"red_box": "right", "blue_can": "right", "green_bar": "left"}


@pytest.mark.slow
def test_object_without_a_grasp_is_left_with_its_reason_after_stirring():
    wide = ("world.objects=[{id: plate, shape: box, x: 0.55, y: 0.0, z: 0.005, size: [0.12, 0.10], height: 0.03, "
            "color: [0.9, 0.1, 0.1]}]")
    _, observer = run(wide)
    status = observer.status
    assert status.state == "DONE" and status.done == 0, status
    assert "STIRRING" in observer.states and status.figures["stirs"] == 3
    assert "plate at (0.550, 0.000): it is 100 mm wide, too wide for the fingers" in status.overlooked
    assert [each.reason for each in status.skipped] == ["plate: it is 100 mm wide, too wide for the fingers"]


@pytest.mark.slow
def test_task_continues_after_crashes_of_its_services():
    outcome, _ = run(faults=True, seed=3)
    assert outcome.ok and not outcome.broken and not outcome.crashes, outcome
    assert outcome.faults["crash"] >= 2
