"""Cells with doubles of perception and planner: task, executor and supervisor in many short runs."""

from functools import cache

import pytest

from common.config import Cell, load_cell
from common.errors import ConfigError
from common.virtual.doubles import settings_of, with_doubles
from common.virtual.simulation import Outcome, Simulation
from tests.simulated.known_bugs import BUGS

pytestmark = pytest.mark.timeout(600)  # some seconds of work, on a machine that may be busy


@cache
def cell_of(name: str) -> Cell:
    application = load_cell(name).application
    return with_doubles(load_cell(name, settings_of(application)))


def outcome_of(name: str, seed: int, faults: bool = True) -> Outcome:
    return Simulation(cell_of(name), seed, faults=faults, digest=True).run()


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_cell_with_doubles_ends_well_whatever_goes_wrong(name):
    outcome = outcome_of(name, 1)
    assert outcome.ok and not outcome.broken and not outcome.crashes, outcome
    assert outcome.faults["crash"] >= 3 and outcome.faults["cut"] >= 1
    assert all(count > 0 for count in outcome.checked.values()) and len(outcome.checked) >= 9


def test_doubles_stand_for_perception_and_planner_and_leave_task_and_executor_as_they_are():
    cell, whole = cell_of("panda"), load_cell("panda")
    assert list(cell.services) == ["motion_planner", "trajectory_executor", "perception", "smart_pick_place"]
    assert cell.services["smart_pick_place"] == whole.services["smart_pick_place"]
    assert cell.services["trajectory_executor"].module == whole.services["trajectory_executor"].module


def test_same_seed_is_the_same_run_with_doubles():
    assert outcome_of("panda", 2).digest == outcome_of("panda", 2).digest


def test_only_the_double_may_see_the_truth():
    with BUGS["the task reads the truth"]():
        assert "nothing that decides saw the truth" in outcome_of("panda", 1).broken[0]


def test_application_without_a_double_is_told_in_one_line():
    cell = load_cell("panda").model_copy(update={"application": "tests.simulated.box_detector"})
    with pytest.raises(ConfigError, match="--doubles"):
        with_doubles(cell)
