"""The handover cell on a virtual clock: a complete run, a receiver that misses, and STOP while objects change hands."""

import asyncio
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from applications.hand_over.task import Config, Giver, Receiver
from applications.hand_over.topics import HANDOVER_STATUS
from common import messages as m
from common import topics
from common.arms import arms_topic
from common.config import Cell, load_cell, service_config
from common.planning.arms.coordinator import Coordinator, Decision
from common.robot.model import RobotModel
from common.tasks.handover import Receiving, backward
from common.tasks.stages import Move
from common.transport.bus import Bus
from lab.simulation import Simulation
from tests.two_arms import judged
from tools.check.cell import wiring

ARMS = ("left", "right")
ONE = ('world.objects=[{id: part_1, shape: box, size: [0.05, 0.04, 0.06], x: 0.5, y: 0.35, yaw: 0.3, '
       'color: [0.9, 0.1, 0.1]}]')


def cell(*settings: str) -> Cell:
    return load_cell("handover", [ONE, "services.depth_camera.rate=1.0", *settings], seed=1)


class Watch:
    """Joint positions of both arms at the same time, and what both grippers report."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.joints = {arm: bus.reader(arms_topic(topics.JOINT_STATES, arm)) for arm in ARMS}
        self.grippers = {arm: bus.reader(arms_topic(topics.GRIPPER_STATE, arm)) for arm in ARMS}
        self.status = {arm: bus.reader(arms_topic(HANDOVER_STATUS, arm)) for arm in ARMS}
        self.motions = {arm: bus.reader(arms_topic(topics.MOTION_STATUS, arm)) for arm in ARMS}
        self.truth = bus.reader(topics.SCENE_OBJECTS)

    def positions(self) -> tuple[np.ndarray, ...]:
        return tuple(np.array(self.joints[arm].latest.position[:7]) for arm in ARMS)  # type: ignore[union-attr]

    def holding(self) -> list[str]:
        return [arm for arm in ARMS if (state := self.grippers[arm].latest) is not None and state.holding]

    def height(self) -> float:
        assert self.truth.latest is not None
        return self.truth.latest.objects[0].pose.position.z

    async def until(self, arm: str, stage: str) -> None:
        while (await self.status[arm].next()).stage != stage:
            pass


@pytest.mark.parametrize(("meeting", "out_of_reach"), [
    ("[0.5, 0.0, 0.45]", {}), ("[0.5, -0.75, 0.45]", {"left": "it is 1.31 m", "right": "the arm cannot"}),
    ("[0.5, -0.45, 0.45]", {"left": ""})])
def test_meeting_place_out_of_reach_is_refused_at_the_start_and_by_check(
    meeting: str, out_of_reach: dict[str, str]
) -> None:
    checked = load_cell("handover", [f"services.hander.meeting={meeting}"])
    entries = {name: entry for name, entry in checked.services.items() if entry.kind == "hander"}
    found = [each.what for each in wiring(checked.model_copy(update={"services": entries})) if "meeting" in each.what]
    assert len(found) == len(out_of_reach)
    for what, (arm, why) in zip(found, out_of_reach.items(), strict=True):
        assert what.startswith(f"services.{arm}_hander.meeting: {meeting} is out of reach of {arm} with the tool")
        assert why in what


@pytest.mark.slow
@pytest.mark.parametrize("simulator", ["kinematic", "mujoco"])
def test_part_goes_from_hand_to_hand_into_the_box_and_the_arms_keep_their_clearance(simulator: str) -> None:
    if simulator == "mujoco":
        pytest.importorskip("mujoco", reason="make setup EXTRAS=physics")
    states: list[tuple[np.ndarray, ...]] = []
    changes: list[list[str]] = [[]]

    async def visit(bus: Bus) -> None:
        watch = Watch(bus)
        while (status := watch.status["right"].latest) is None or status.state not in ("DONE", "ERROR"):
            await watch.joints["right"].next()
            if watch.joints["left"].latest is not None:
                states.append(watch.positions())
            if watch.holding() != changes[-1]:
                changes.append(watch.holding())

    config = cell(f"world.simulator={simulator}")
    outcome = Simulation(config, 1, visit=visit).run()
    assert (outcome.state, outcome.done, outcome.total, outcome.crashes) == ("DONE", 1, 1, []), outcome
    assert changes == [[], ["left"], ["left", "right"], ["right"], []]
    robots = [RobotModel.load(robot) for robot in config.robots.values()]
    assert min(judged(*robots, states, 0.02)) > 0.02  # type: ignore[arg-type]


@pytest.fixture
def short_of_the_object(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Let the receiver reach short of the object while the list is not empty."""
    attempts: list[str] = []
    line = Receiving._line

    def shorter(self: Receiving, name: str, *rest: object) -> Move:
        if name == "reach" and attempts:
            attempts.pop()
            state, cycle, ends, *others = rest
            rest = (state, cycle, [backward(end, 0.06) for end in ends], *others)  # type: ignore[attr-defined]
        return line(self, name, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(Receiving, "_line", shorter)
    yield attempts


@pytest.mark.slow
@pytest.mark.parametrize("misses", [1, pytest.param(2, marks=pytest.mark.campaign)])
def test_receiver_that_misses_tries_again_or_ends_and_the_giver_holds_on(
    misses: int, short_of_the_object: list[str]
) -> None:
    short_of_the_object += ["again"] * misses
    seen: list[tuple[list[str], float]] = []

    async def visit(bus: Bus) -> None:
        watch = Watch(bus)
        await watch.until("right", "close")
        while (await watch.grippers["right"].next()).state == "active":
            pass
        seen.append((watch.holding(), watch.height()))
        while watch.status["left"].latest is None or watch.status["left"].latest.state not in ("DONE", "ERROR"):
            await watch.status["left"].next()
        seen.append((watch.holding(), watch.height()))

    outcome = Simulation(cell("services.right_hander.most_tries=2"), 1, visit=visit).run()
    assert seen[0] == (["left"], pytest.approx(0.45, abs=0.02))
    if misses == 1:
        assert (outcome.state, outcome.done, outcome.total) == ("DONE", 1, 1), outcome
    else:
        assert outcome.state == "ERROR" and "the fingers closed on nothing" in outcome.message, outcome
        assert "left: the task of right has ended" in outcome.message
        assert seen[1] == (["left"], pytest.approx(0.45, abs=0.02))


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "stage"), [
    ("left", "hand over"),
    *(pytest.param(*row, marks=pytest.mark.campaign)
      for row in (("right", "reach"), ("right", "close"), ("left", "withdraw")))])
def test_stop_while_a_part_changes_hands_drops_nothing_and_only_a_start_continues(arm: str, stage: str) -> None:
    async def visit(bus: Bus) -> None:
        watch = Watch(bus)
        await watch.until(arm, stage)
        await asyncio.sleep(0.1)
        await bus.client(topics.MOTION_STOP).call(m.StopRequest(reason="test"))
        for motion in watch.motions.values():
            while not (status := motion.latest or await motion.next()).stopped or status.state == "active":
                await motion.next()
        for gripper in watch.grippers.values():  # fingers finish what they have begun
            while (gripper.latest or await gripper.next()).moving:
                await gripper.next()
        before, held = watch.positions(), watch.holding()
        await asyncio.sleep(5.0)  # virtual: nothing moves meanwhile
        assert np.abs(np.subtract(watch.positions(), before)).max() < 1e-4  # [rad]
        assert watch.holding() == held and held and watch.height() == pytest.approx(0.45, abs=0.02)
        await bus.client(topics.TASK_COMMAND).call(m.TaskCommand(command="start"))

    outcome = Simulation(cell(), 1, visit=visit).run()
    assert (outcome.state, outcome.done, outcome.total, outcome.crashes) == ("DONE", 1, 1, []), outcome


@pytest.mark.parametrize(("arm", "task"), [("left", Giver), ("right", Receiver)])
def test_each_arm_has_a_complete_task(arm: str, task: type[Giver | Receiver]) -> None:
    config = service_config(cell(), f"{arm}_hander", Config)
    assert task(config, m.TaskStatus(), arm).status.state == "IDLE"


@pytest.mark.slow
def test_giver_whose_way_out_was_refused_withdraws_in_a_straight_line(monkeypatch: pytest.MonkeyPatch) -> None:
    refused: list[str] = []
    request = Coordinator.request

    def refuse_once(self: Coordinator, arm: str, goal: str, *rest: Any, **more: Any) -> Decision:
        if arm == "left" and self.arms["right"].body.carried and not refused:
            refused.append(goal)
        if goal in refused:
            return Decision("refused", "blocked", "refused by the test")
        return request(self, arm, goal, *rest, **more)

    monkeypatch.setattr(Coordinator, "request", refuse_once)
    outcome = Simulation(cell(), 1).run()
    assert (outcome.state, outcome.done, outcome.total, outcome.crashes) == ("DONE", 1, 1, []), outcome
    assert refused


@pytest.mark.slow
def test_receiver_that_comes_back_late_looks_where_its_box_is_free_before_it_takes_the_next_part() -> None:
    ends: list[m.WorldObject] = []

    async def visit(bus: Bus) -> None:
        watch = Watch(bus)
        await watch.until("right", "home")
        hold = bus.client(arms_topic(topics.MOTION_HOLD, "right"))
        await hold.call(m.HoldRequest(hold=True, owner="ann"))
        while (status := await watch.status["left"].next()).message != "waits until right holds the object":
            pass
        await hold.call(m.HoldRequest(hold=False, owner="ann"))
        while (status := await watch.status["right"].next()).state not in ("DONE", "ERROR"):
            pass
        assert watch.truth.latest is not None and status.state == "DONE"
        ends.extend(watch.truth.latest.objects)

    second = ONE.replace("part_1", "part_2").replace("x: 0.5, y: 0.35", "x: 0.42, y: 0.52")[len("world.objects=["):]
    outcome = Simulation(cell(f"{ONE[:-1]}, {second}"), 1, visit=visit).run()
    assert (outcome.state, outcome.done, outcome.total) == ("DONE", 2, 2), outcome
    assert [part.pose.position.z for part in ends] == pytest.approx([0.035, 0.035], abs=0.002)


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "stage"), [
    pytest.param("right", "close", marks=pytest.mark.campaign), ("right", "across"), ("left", "offer")])
def test_part_gets_into_the_box_although_a_restart_forgot_what_an_arm_holds(arm: str, stage: str) -> None:
    async def visit(bus: Bus) -> None:
        watch = Watch(bus)
        await watch.until(arm, stage)
        while arm not in watch.holding():
            await watch.grippers[arm].next()
        simulation.kill(f"{arm}_scene_manager")

    simulation = Simulation(cell(), 1, visit=visit)
    outcome = simulation.run()
    assert (outcome.state, outcome.done, outcome.total, outcome.crashes) == ("DONE", 1, 1, []), outcome
    assert outcome.restarts
