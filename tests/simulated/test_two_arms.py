"""A cell with two arms in one simulated world: both clear their side at the same time."""

from pathlib import Path

import numpy as np
import pytest

from common import messages as m
from common import topics
from common.arms import arms_topic
from common.config import load_cell
from common.errors import RemoteError
from common.robot.model import RobotModel
from common.robot.transforms import invert, pose_to_matrix
from lab.simulation import Simulation

CELL = str(Path(__file__).parents[1] / "data" / "two_arms.yaml")


@pytest.mark.slow
def test_both_arms_clear_their_side_of_the_table_into_their_own_box() -> None:
    contained: dict[str, str] = {}
    cell, moved = load_cell(CELL), {"left": 0.0, "right": 0.0}  # [m] by which an object moved in the hand, at most

    async def visit(bus) -> None:
        objects = bus.reader(topics.SCENE_OBJECTS)
        joints = {arm: bus.reader(arms_topic(topics.JOINT_STATES, arm)) for arm in moved}
        robots = {arm: RobotModel.load(cell.robots[arm]) for arm in moved}
        offsets: dict[str, list[np.ndarray]] = {"left": [], "right": []}
        while len(contained) < 2:
            truth = await objects.next()
            contained.update({each.id: each.container for each in truth.objects if each.state == "contained"})
            for each in truth.objects:
                arm = "left" if each.id == "ball_1" else "right"
                if each.state == "held" and abs(joints[arm].latest.header.stamp - truth.header.stamp) < 1e6:
                    tcp = robots[arm].fk(np.array(joints[arm].latest.position[:7]))
                    offsets[arm].append((invert(tcp) @ pose_to_matrix(each.pose))[:3, 3])
        moved.update({arm: float(np.ptp(offsets[arm], axis=0).max()) for arm in moved})

    outcome = Simulation(cell, 1, visit=visit, limit=60.0).run()
    assert max(moved.values()) < 1e-6, "the ground truth is as old as the joint states of each arm"
    assert (outcome.state, outcome.done, outcome.total) == ("DONE", 2, 2), outcome
    assert contained == {"ball_1": "box_left", "ball_2": "box_right"}
    assert outcome.crashes == [] and outcome.restarts == {}


@pytest.mark.slow
def test_one_arm_is_held_alone_while_the_other_moves() -> None:
    states: dict[str, m.MotionStatus] = {}

    async def visit(bus) -> None:
        readers = {arm: bus.reader(arms_topic(topics.MOTION_STATUS, arm)) for arm in ("left", "right")}
        hold = bus.client(arms_topic(topics.MOTION_HOLD, "left"))
        while not all(reader.latest and reader.latest.state == "active" for reader in readers.values()):
            await readers["right"].next()
        await hold.call(m.HoldRequest(hold=True, owner="ann"))
        goal = readers["right"].latest.id
        while readers["right"].latest.id == goal or readers["right"].latest.held:  # the next one has permission
            await readers["right"].next()
        states.update({arm: reader.latest for arm, reader in readers.items()})
        await hold.call(m.HoldRequest(hold=False, owner="ann"))

    outcome = Simulation(load_cell(CELL), 1, visit=visit, limit=60.0).run()
    assert states["left"].held and not states["right"].held
    assert (outcome.state, outcome.done) == ("DONE", 2), outcome


@pytest.mark.slow
def test_nothing_moves_without_the_coordinator(tmp_path: Path) -> None:
    cell = tmp_path / "two.yaml"
    cell.write_text(Path(CELL).read_text(encoding="utf-8").replace("  arm_coordinator: {}\n", ""), encoding="utf-8")
    positions, errors = set[tuple[float, ...]](), set[str]()

    async def visit(bus) -> None:
        states = bus.reader(arms_topic(topics.JOINT_STATES, "left"))
        motion = bus.reader(arms_topic(topics.MOTION_STATUS, "left"))
        while not errors:
            positions.add(tuple((await states.next()).position[:7]))
            if motion.latest is not None and motion.latest.error:
                errors.add(motion.latest.error)

    Simulation(load_cell(str(cell)), 1, visit=visit, limit=15.0).run()
    assert errors == {"no_coordinator"}
    assert len(positions) == 1


@pytest.mark.slow
def test_motions_that_are_not_proved_against_the_other_arm_are_refused() -> None:
    codes: dict[str, str] = {}

    async def visit(bus) -> None:
        states = await bus.reader(arms_topic(topics.JOINT_STATES, "left")).next()
        here = m.JointTrajectory(joint_names=states.name[:7], points=[
            m.JointTrajectoryPoint(positions=states.position[:7], velocities=[0.0] * 7, accelerations=[0.0] * 7,
                                   time_from_start=at) for at in (0.0, 1.0)])
        by_force = bus.client(arms_topic(topics.MOTION_FORCE, "left"))
        answer = await by_force.call(m.ForceMotion(id="f", kind="until", trajectory=here, header=bus.header("world")))
        codes["force"] = answer.error
        execute = bus.client(arms_topic(topics.MOTION_EXECUTE, "left"))
        codes["joining"] = (await execute.call(m.ExecuteRequest(
            id="j", trajectory=here, joins="another", header=bus.header("world")))).error
        order = bus.client(arms_topic(topics.ROBOT_COMMAND, "left"))
        with pytest.raises(RemoteError) as refused:
            await order.call(m.RobotCommand(act="freedrive", value=1.0))
        codes["freedrive"] = refused.value.code

    Simulation(load_cell(CELL), 1, visit=visit, limit=8.0).run()
    assert codes == dict.fromkeys(("force", "joining", "freedrive"), "several_arms")


@pytest.mark.slow
@pytest.mark.parametrize("pressed", [pytest.param("left", marks=pytest.mark.campaign), "right"])
def test_stop_of_an_operator_on_one_arm_stops_both_and_a_task_stops_only_its_own(pressed: str) -> None:
    seen: dict[str, m.MotionStatus] = {}

    async def visit(bus) -> None:
        readers = {arm: bus.reader(arms_topic(topics.MOTION_STATUS, arm)) for arm in ("left", "right")}
        while not all(reader.latest and reader.latest.state == "active" for reader in readers.values()):
            await readers["right"].next()
        stop = bus.client(arms_topic(topics.MOTION_STOP, pressed))
        await stop.call(m.StopRequest(id="no goal of anyone", by="requester"))
        assert not any(reader.latest.stopped for reader in readers.values())
        await stop.call(m.StopRequest(owner="ann", reason="test"))
        while not all(reader.latest.stopped for reader in readers.values()):
            await readers["left" if pressed == "right" else "right"].next()
        seen.update({arm: reader.latest for arm, reader in readers.items()})

    Simulation(load_cell(CELL), 1, visit=visit, limit=8.0).run()
    assert {arm: [each.by for each in status.interlocks] for arm, status in seen.items()} == {
        "left": ["ann"], "right": ["ann"]}
