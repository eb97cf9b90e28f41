"""Cells on the virtual clock with faults: they end well, the same each time, and known bugs are found."""

from functools import cache

import pytest

from common.config import load_cell
from common.errors import ConfigError
from lab.campaign import run_seeds
from lab.faults import SKEW, SPEEDS, make_plan
from lab.observers import with_observed_arm
from lab.simulation import LIMIT, Outcome, Simulation
from tests.simulated.known_bugs import BUGS, RARE, found_within

PANDA = load_cell("panda", ["world.count=2"])
AT_ONCE = ["what is not newer is read", "the task reads the truth", "a request that waits without end"]


@cache
def outcome_of(name: str, seed: int) -> Outcome:
    """Run each cell and seed once."""
    return Simulation(PANDA if name == "panda" else load_cell(name), seed, faults=True, digest=True).run()


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "seed"), [
    ("panda", 1),
    ("ur5", 2),
    pytest.param("panda", 2, marks=pytest.mark.campaign),  # the liveliness reply is late, to a second instance
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
def test_campaign_run_is_reproduced_by_its_seed():
    [in_campaign] = run_seeds(PANDA, [1], True, 1, LIMIT)
    alone = outcome_of("panda", 1)
    assert (in_campaign.messages, in_campaign.seconds, in_campaign.requests, in_campaign.faults) == (
        alone.messages, alone.seconds, alone.requests, alone.faults)


@pytest.mark.slow
def test_campaign_replaces_worker_processes(monkeypatch):
    monkeypatch.setattr("lab.campaign.SEEDS_A_PROCESS", 1)
    outcomes = [*run_seeds(PANDA, [1, 2], False, 1, 0.5)]  # none ends within that time
    assert [outcome.seed for outcome in outcomes] == [1, 2]


@pytest.mark.parametrize(
    "bug", [bug if bug in AT_ONCE else pytest.param(bug, marks=pytest.mark.campaign) for bug in BUGS])
def test_known_bug_is_found_within_tens_of_seeds(bug):
    assert found_within(bug, 400 if bug in RARE else 30) is not None


def test_every_plan_has_three_crashes_a_cut_and_wrong_clocks():
    for seed in range(200):
        plan = make_plan(seed, ["one", "two", "three"])
        kinds = [fault.kind for fault in plan.faults]
        assert kinds.count("crash") >= 3 and kinds.count("cut") >= 1 and kinds.count("late goal") >= 2
        assert [fault.at for fault in plan.faults] == sorted(fault.at for fault in plan.faults)
        assert plan.links.loss > 0 and plan.links.hiccup > 0 and plan.links.duplicated > 0 and plan.links.late > 0
        assert plan.shuffled and plan.speed in (1.0, *SPEEDS)
        assert all(abs(skew) <= SKEW for _, skew in plan.skews) and len(plan.skews) == 3
    assert make_plan(1, ["one", "two"]) == make_plan(1, ["one", "two"]) != make_plan(2, ["one", "two"])


def test_real_arm_cannot_be_simulated(tmp_path, monkeypatch):
    (tmp_path / "real_arms").mkdir()
    (tmp_path / "real_arms" / "__init__.py").write_text("")
    (tmp_path / "real_arms" / "steel.py").write_text(
        "from common.hardware.mock import Options, create\nsimulated = False\n__all__ = ['Options', 'create']\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match="is a real arm"):
        with_observed_arm(load_cell("panda", ["robot.hardware.backend=real_arms.steel"]))
