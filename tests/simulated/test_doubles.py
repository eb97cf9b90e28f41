"""Cells with doubles of perception and planner: task, executor and supervisor in many short runs."""

from functools import cache

import pytest

from common import topics
from common.client.joining import newest_interlock
from common.config import Cell, load_cell
from common.errors import ConfigError
from common.messages import StopRequest, TaskCommand
from common.transport.bus import Bus
from lab.doubles import settings_of, with_doubles
from lab.faults import LAST, make_plan
from lab.simulation import Outcome, Simulation
from tests.harness import until
from tests.simulated.known_bugs import BUGS
from tests.simulated.lost_decisions import DECISIONS, found_in


@cache
def cell_of(name: str) -> Cell:
    return with_doubles(load_cell(name, settings_of(load_cell(name).application)))


@cache
def outcome_of(name: str, seed: int) -> Outcome:
    return Simulation(cell_of(name), seed, faults=True, digest=True).run()


def slow(*row):
    return pytest.param(*row, marks=pytest.mark.slow)


@pytest.mark.parametrize(("name", "seed"), [
    ("panda", 1),
    ("ur5", 1),
    slow("panda", 21),  # a start is on its way when the robot is held
    slow("panda", 5848),  # the released object is detected before the task receives the release
    slow("ur5", 31),  # the robot is held for good while the next executor waits for the end of another
    slow("ur5", 39),  # the arm moves meanwhile
])
def test_cell_with_doubles_succeeds_under_all_faults(name, seed):
    outcome = outcome_of(name, seed)
    assert outcome.ok and not outcome.broken and not outcome.crashes, outcome
    assert outcome.faults["crash"] >= 2 and outcome.faults["malformed messages"] >= 1
    assert all(count > 0 for count in outcome.checked.values()) and len(outcome.checked) >= (9 if outcome.left else 10)


def test_same_seed_is_the_same_run_with_faults():
    first = outcome_of("panda", 1)
    outcome_of.cache_clear()
    assert (outcome_of("panda", 1).digest, outcome_of("panda", 1).faults) == (first.digest, first.faults)


def test_every_plan_has_malformed_messages_and_some_have_each_other_fault():
    plans = [make_plan(seed, ["one", "two"], 0.5) for seed in range(100)]
    kinds = [{fault.kind for fault in plan.faults} for plan in plans]
    assert all("malformed messages" in each for each in kinds)
    assert all(5 < sum(kind in each for each in kinds) < 90 for kind in LAST if kind != "malformed messages")
    assert make_plan(1, ["one"], without=LAST).faults == tuple(
        fault for fault in make_plan(1, ["one"]).faults if fault.kind not in LAST)


@pytest.mark.campaign
def test_run_that_an_operator_leaves_stopped_ends_at_standstill():
    outcomes = (outcome_of("panda", seed) for seed in range(1, 101))  # about every tenth
    left = []
    for outcome in (outcome for outcome in outcomes if outcome.faults["left stopped"]):
        assert outcome.ok
        left.append(outcome.state)
        if left[-1] == "LEFT":
            break
    assert left[-1] == "LEFT" and set(left[:-1]) <= {"DONE"}  # another operator had started it again


def test_start_must_acknowledge_the_newest_stop():
    async def visit(bus: Bus) -> None:
        task = bus.client(topics.TASK_COMMAND)
        assert await newest_interlock(bus) == 0
        stopped = await bus.client(topics.MOTION_STOP).call(StopRequest(owner="anna"))
        await until(bus.reader(topics.MOTION_STATUS), lambda status: bool(status.interlocks))
        assert await newest_interlock(bus) == stopped.newest > 0
        await task.call(TaskCommand(command="start", acknowledged=stopped.newest - 1))
        assert await newest_interlock(bus) == stopped.newest, "a late start releases nothing"
        await task.call(TaskCommand(command="start", acknowledged=stopped.newest))

    assert Simulation(cell_of("panda"), 1, visit=visit).run().ok


@pytest.mark.campaign
@pytest.mark.parametrize("bug", DECISIONS)
def test_interlock_bug_is_found_within_tens_of_seeds(bug):
    [seed], report = found_in("panda", bug, range(1, 401), enough=1)  # the rarest is seen in one of thirty
    assert report.startswith("BROKEN"), f"{seed}: {report}"


def test_only_the_double_may_read_the_ground_truth():
    with BUGS["the task reads the truth"]():
        outcome = Simulation(cell_of("panda"), 1, faults=True).run()
    assert "no deciding service reads the ground truth" in outcome.broken[0]


def test_application_without_a_double_is_rejected(tmp_path, monkeypatch):
    (tmp_path / "no_double").mkdir()
    (tmp_path / "no_double" / "app.py").write_text(
        "from common.application import Application, ApplicationTopics\n"
        "from common.messages import TaskStatus\nfrom common.topics import Topic\n"
        "STATUS = Topic('no_double_status', TaskStatus, 'state', '')\n"
        "APPLICATION = Application(topics=ApplicationTopics(status=STATUS))\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match="--doubles"):
        with_doubles(load_cell("panda").model_copy(update={"application": "no_double.app"}))
