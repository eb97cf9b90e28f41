"""Complete cells in the world with physics, on the virtual clock: one line in the cell selects it."""

from pathlib import Path

import pytest

from common import topics
from common.transport.bus import Bus
from tests.harness import until
from tests.simulated.visited import SimulatedCell, in_box

pytest.importorskip("mujoco")
PHYSICS = "world.simulator=mujoco"
DATA = Path(__file__).parents[1] / "data"


@pytest.mark.slow
def test_executor_killed_while_holding_finds_the_object_again() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        await until(bus.reader(topics.GRIPPER_STATE), lambda state: state.holding and state.outcome == "grasped")
        await bus.clock.sleep(1.0)  # on its way
        cell.kill("trajectory_executor")

    summary = SimulatedCell("panda", [PHYSICS, "world.count=1"], visit=visit).summary
    assert summary["restarts"] == {"trajectory_executor": 1}
    assert (summary["state"], summary["truth"]) == ("DONE", in_box(1))


@pytest.mark.slow
def test_two_arms_continue_after_their_executor_was_killed_and_each_fills_its_own_box() -> None:
    joints: dict[str, list[list[float]]] = {"left": [], "right": []}

    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        await until(bus.of_arm("right").reader(topics.GRIPPER_STATE), lambda state: state.holding)
        await bus.clock.sleep(0.5)  # on its way
        readers = {arm: bus.of_arm(arm).reader(topics.JOINT_STATES) for arm in joints}
        before = {arm: (await reader.next()) for arm, reader in readers.items()}
        cell.kill("trajectory_executor")
        for arm, reader in readers.items():
            state = await until(reader, lambda s, arm=arm: s.header.stamp > before[arm].header.stamp + 500_000_000)
            joints[arm] = [before[arm].position, state.position]

    small = ["width=320", "height=214", "fx=174", "fy=174", "cx=160", "cy=107"]
    summary = SimulatedCell(DATA / "two_arms.yaml", [
        PHYSICS, *(f"world.camera.{value}" for value in small), "services.vision_detector.min_contour_area_px=20",
    ], visit=visit).summary
    assert summary["restarts"] == {"trajectory_executor": 1}
    assert (summary["state"], summary["truth"]["containers"]) == ("DONE", {"box_left": 1, "box_right": 1})
    for before, after in joints.values():
        assert after == pytest.approx(before, abs=0.05), "each arm is where it was, not at home"


@pytest.mark.slow
@pytest.mark.parametrize(("count", "seed"), [
    (1, 1), *(pytest.param(7, seed, marks=pytest.mark.campaign) for seed in (1, 2))])
def test_balls_placed_by_friction_alone_stay_in_the_box(count: int, seed: int) -> None:
    layout = [PHYSICS, "world.layout=random", f"world.count={count}", f"seed={seed}"]
    summary = SimulatedCell("panda", layout, seed=seed).summary
    assert (summary["state"], summary["truth"], summary["placed"]) == ("DONE", in_box(count), count)


@pytest.mark.slow
def test_outline_with_servo_physics_is_as_accurate_as_without() -> None:
    summary = SimulatedCell("ur5", [PHYSICS], world="w2").summary
    assert summary["state"] == "DONE"
    assert summary["outline"]["deviation_mm"]["mean"] < 0.5 and summary["outline"]["closed"]
