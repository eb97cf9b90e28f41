"""Cells on the virtual clock in which things go wrong: they end well, the same each time, and bugs are found."""

from functools import cache

import pytest

from common.config import load_cell
from common.errors import ConfigError
from lab.campaign import run_seeds
from lab.faults import SKEW, SPEEDS, make_plan
from lab.observers import with_observed_arm
from lab.simulation import LIMIT, Outcome, Simulation
from tests.simulated.known_bugs import BUGS, RARE, found_within

pytestmark = pytest.mark.timeout(600)  # some seconds of work, on a machine that may be busy


PANDA = load_cell("panda", ["world.count=2"])


@cache
def outcome_of(name: str, seed: int) -> Outcome:
    """Run each cell and seed once."""
    return Simulation(PANDA if name == "panda" else load_cell(name), seed, faults=True, digest=True).run()


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "seed"), [
    ("panda", 1),
    pytest.param("panda", 2, marks=pytest.mark.campaign),  # the answer to who is there comes late, to a second instance
    ("ur5", 2),
    pytest.param("ur5", 22, marks=pytest.mark.campaign),  # stopped where it cannot go up any further
    pytest.param("ur5", 45, marks=pytest.mark.campaign),  # jogged towards the pedestal of the object, in a fast cell
])
def test_cell_succeeds_under_all_faults(cell, seed):
    outcome = outcome_of(cell, seed)
    assert outcome.ok and not outcome.broken and not outcome.crashes, outcome
    assert outcome.faults["crash"] >= 3 and outcome.faults["cut"] >= 1 and outcome.faults["reordered"] > 100
    assert sum(outcome.restarts.values()) >= 3
    assert all(count > 0 for count in outcome.checked.values()) and len(outcome.checked) >= 9


@pytest.mark.slow
def test_same_seed_is_the_same_run_with_faults():
    first, second = outcome_of("panda", 1), Simulation(PANDA, 1, faults=True, digest=True).run()
    assert first.digest == second.digest and first.faults == second.faults


@pytest.mark.slow
def test_campaign_run_is_reproduced_by_its_seed():
    [among_others] = run_seeds(PANDA, [1], True, 1, LIMIT)
    alone = outcome_of("panda", 1)
    assert (among_others.messages, among_others.seconds, among_others.requests, among_others.faults) == (
        alone.messages, alone.seconds, alone.requests, alone.faults)


@pytest.mark.slow
def test_campaign_replaces_worker_processes(monkeypatch):
    monkeypatch.setattr("lab.campaign.SEEDS_A_PROCESS", 1)
    outcomes = [*run_seeds(PANDA, [1, 2, 3], False, 1, 1.0)]  # none ends within that time
    assert [outcome.seed for outcome in outcomes] == [1, 2, 3]


AT_ONCE = ["what is not newer is read", "the task reads the truth", "a request that waits without end"]


@pytest.mark.parametrize(
    "bug", [bug if bug in AT_ONCE else pytest.param(bug, marks=pytest.mark.campaign) for bug in BUGS])
def test_known_bug_is_found_within_tens_of_seeds(bug):
    assert found_within(bug, 400 if bug in RARE else 30) is not None


def test_at_least_ten_bugs_are_known():
    assert len(BUGS) >= 10 and set(AT_ONCE) < set(BUGS)


def test_every_plan_has_three_crashes_a_cut_and_wrong_clocks():
    for seed in range(200):
        plan = make_plan(seed, ["one", "two", "three"])
        kinds = [fault.kind for fault in plan.faults]
        assert kinds.count("crash") >= 3 and kinds.count("cut") >= 1 and kinds.count("late goal") >= 2
        assert [fault.at for fault in plan.faults] == sorted(fault.at for fault in plan.faults)
        assert plan.links.loss > 0 and plan.links.hiccup > 0 and plan.links.duplicated > 0 and plan.links.late > 0
        assert plan.shuffled and plan.speed in (1.0, *SPEEDS)
        assert all(abs(skew) <= SKEW for _, skew in plan.skews) and len(plan.skews) == 3


def test_plans_of_two_seeds_differ():
    assert make_plan(1, ["one", "two"]) != make_plan(2, ["one", "two"])
    assert make_plan(1, ["one", "two"]) == make_plan(1, ["one", "two"])


def test_real_arm_cannot_be_simulated(tmp_path, monkeypatch):
    (tmp_path / "steel.py").write_text(
        "from common.hardware.mock import Options, create\nsimulated = False\n__all__ = ['Options', 'create']\n")
    (tmp_path / "of").mkdir()
    (tmp_path / "of" / "__init__.py").write_text("")
    (tmp_path / "steel.py").rename(tmp_path / "of" / "steel.py")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match="is a real arm"):
        with_observed_arm(load_cell("panda", ["robot.hardware.backend=of.steel"]))
