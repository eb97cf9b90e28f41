"""The coordinator with real trajectory controllers on a virtual clock; an independent judge measures the distances."""

from collections.abc import Callable

import numpy as np
import pytest

from common.planning.arms.arm import Options
from common.planning.arms.band import Delays, braking_time
from common.planning.arms.coordinator import RETREAT, Coordinator
from common.planning.arms.schedules import ScheduleKeeper
from tests.two_arms import RandomRequests, TwoArms, reachable

BOUND = 20.0  # [s] in which every request must be over


def middle(sim: TwoArms, arm: str, seed: int = 3) -> np.ndarray:
    return reachable(sim.robots[arm], 1, seed)[0]


def both_to_the_middle() -> TwoArms:
    sim = TwoArms()
    sim.execute("left", "in", sim.path_to("left", middle(sim, "left")))
    sim.run(0.1)
    sim.execute("right", "other", sim.path_to("right", middle(sim, "right")))
    return sim


def test_an_arm_at_rest_that_obstructs_an_older_request_moves_back() -> None:
    sim = both_to_the_middle()
    sim.run(10.0)
    assert sim.results["in"].state == sim.results["other"].state == "succeeded"
    assert [goal for goal in sim.results if goal.startswith(RETREAT)] == ["retreat-1"]
    assert min(sim.judged()) > 0.0


def test_proofs_that_take_longer_than_a_step_continue_in_the_next_one() -> None:
    sim = TwoArms(Options(effort=2))
    sim.execute("left", "in", sim.path_to("left", middle(sim, "left")))
    sim.run(10.0)
    sim.execute("right", "other", sim.path_to("right", middle(sim, "right")))
    sim.run(20.0)
    assert sim.results["in"].state == sim.results["other"].state == "succeeded"


def test_an_arm_follows_one_that_leaves_before_that_has_come_to_rest() -> None:
    sim = both_to_the_middle()
    sim.run(0.5)
    while sim.results["in"].state == "":
        sim.run(0.1)
    sim.execute("left", "out", sim.path_to("left", sim.robots["left"].named("home"), 0.1))
    sim.run(10.0)
    assert sim.results["out"].state == sim.results["other"].state == "succeeded"
    assert not any(goal.startswith(RETREAT) for goal in sim.results)
    assert sim.moved_at("right", 1.0) < sim.results["out"].over - 0.5
    assert min(sim.judged()) > 0.0


def test_a_motion_that_the_other_arm_blocks_even_at_home_is_refused_with_the_links() -> None:
    sim = TwoArms(distance=0.75)
    into = sim.robots["left"].named("home") + np.array([0.0, 1.1, 0.0, 0.7, 0.0, 0.3, 0.0])
    sim.execute("left", "far", sim.path_to("left", into))
    sim.run(1.0)
    assert (sim.results["far"].state, sim.results["far"].error) == ("cancelled", "blocked")
    assert "right at home" in sim.arms["left"].controller.status.message


@pytest.mark.parametrize("what", ["hold", "slow", "stop"])
def test_the_other_arm_waits_only_where_the_rest_of_its_motion_is_not_free(what: str) -> None:
    """An arm on its way out of the middle is held, slowed or stopped while the other one is on its way in."""
    sim = both_to_the_middle()
    sim.run(0.5)
    while sim.results["in"].state == "":
        sim.run(0.1)
    sim.execute("left", "out", sim.path_to("left", sim.robots["left"].named("home"), 0.1))
    left = sim.arms["left"]
    while sim.coordinator.arms["right"].committed is None:
        sim.run(0.05)
    disturb: dict[str, Callable[[], object]] = {
        "hold": lambda: left.controller.hold(True, "an operator", "operator"),
        "slow": lambda: setattr(left, "scaling", 0.1),
        "stop": lambda: left.controller.cancel("out", "stopped", sim.now)}
    disturb[what]()
    sim.run(3.0)
    left.controller.hold(False, "", "operator")
    left.scaling = 1.0
    sim.run(BOUND)
    assert sim.unfinished() == {}
    assert sim.results["other"].state == "succeeded"
    assert min(sim.judged()) > 0.0


def test_an_arm_held_alone_far_away_does_not_hold_the_other_one() -> None:
    sim = TwoArms()
    aside = sim.robots["left"].named("home") + np.array([-1.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    sim.execute("left", "aside", sim.path_to("left", aside, 0.2))
    sim.run(0.4)
    sim.execute("right", "in", sim.path_to("right", middle(sim, "right")))
    sim.run(0.4)
    sim.arms["left"].controller.hold(True, "an operator", "operator")
    sim.run(5.0)
    assert sim.results["in"].state == "succeeded"
    assert sim.results["aside"].state == ""
    sim.arms["left"].controller.hold(False, "", "operator")
    sim.run(5.0)
    assert sim.results["aside"].state == "succeeded"
    assert min(sim.judged()) > 0.0


def test_nothing_new_moves_without_the_coordinator_and_a_running_motion_ends() -> None:
    sim = TwoArms()
    sim.execute("left", "in", sim.path_to("left", middle(sim, "left")))
    sim.run(0.5)
    sim.alive = False
    sim.execute("right", "other", sim.path_to("right", middle(sim, "right")))
    sim.run(4.0)
    assert sim.results["in"].state == "succeeded"
    assert sim.results["other"].state == ""
    assert np.array_equal(sim.arms["right"].q, sim.robots["right"].named("home"))


def test_a_motion_that_a_coordinator_held_on_its_path_ends_after_a_restart_of_that() -> None:
    sim = TwoArms()
    sim.execute("left", "in", sim.path_to("left", middle(sim, "left"), 0.1))
    sim.run(1.0)
    sim.arms["left"].controller.hold(True, "right is behind its schedule", "coordinator")
    sim.coordinator = Coordinator(sim.geometry.values(), Options(), lambda *_: True)
    sim.keeper = ScheduleKeeper(sim.coordinator)
    sim.run(5.0)
    assert (sim.results["in"].state, sim.results["in"].error) == ("cancelled", "restarted")
    sim.execute("left", "again", sim.path_to("left", middle(sim, "left")))
    sim.run(5.0)
    assert sim.results["again"].state == "succeeded"


def test_an_arm_moves_alone_only_while_the_others_rest() -> None:
    sim = TwoArms()
    ask = sim.coordinator.request
    sim.execute("left", "in", sim.path_to("left", middle(sim, "left"), 0.1))
    sim.run(0.5)
    assert ask("right", "jog", None, sim.now).state == "wait"
    while sim.results["in"].state == "":
        sim.run(0.1)
        ask("right", "jog", None, sim.now)
    sim.run(0.2)
    assert ask("right", "jog", None, sim.now).state == "granted"
    sim.execute("left", "out", sim.path_to("left", sim.robots["left"].named("home")))
    sim.run(0.5)
    assert sim.results["out"].state == ""
    assert sim.coordinator.arms["left"].ticket is not None
    assert sim.coordinator.arms["left"].ticket.reason == "right moves alone"
    sim.run(4.0)
    assert sim.results["out"].state == "succeeded"


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_the_band_contains_what_braking_takes(share: float) -> None:
    sim = TwoArms(coordinate=False)
    path = sim.path_to("left", middle(sim, "left"), share)
    sim.execute("left", "in", path)
    sim.run(path.duration / 2)
    controller = sim.arms["left"].controller
    before = controller.status.path_time
    controller.hold(True, "", "coordinator")
    sim.run(1.0)
    limits = sim.coordinator.arms["left"].limits
    assert controller.status.path_time - before <= braking_time(path, limits)
    assert Delays().band(braking_time(path, limits)) > braking_time(path, limits) + Delays().report


@pytest.mark.parametrize("seed", [0, 1])
def test_every_random_request_is_over_in_bounded_time_without_contact(seed: int) -> None:
    sim = TwoArms(Options(patience=0.5), seed=seed)
    sim.run(12.0, RandomRequests(sim, seed))
    times = [result.over - result.requested for result in sim.results.values() if result.state]
    assert len(times) > 5
    assert max([*times, *sim.unfinished().values()]) < BOUND
    assert sim.largest_gap < Delays().band()
    assert min(sim.judged(0.05)) > 0.0
