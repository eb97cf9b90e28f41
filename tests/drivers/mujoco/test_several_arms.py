"""Two arms in one world with physics: each has its own servos, fingers and sensor, and they touch each other."""

import contextlib

import numpy as np
import pytest

from common.config import World, load_cell
from common.hardware.interface import HardwareFault, Limits
from common.messages import Header, WorldEdit
from common.planning.ik import solve_ik
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.sim.interface import load_world
from common.sim.several_arms import worlds_of
from tests.two_arms import TwoArms

PERIOD = 0.01  # [s] of a cycle of control
BALLS = [[0.48, 0.3], [0.48, -0.3]]
WALL = {"id": "wall", "shape": "box", "dimensions": [0.2, 0.8, 1.2], "position": [0.55, 0.0, 0.2]}
BLOCK = {"id": "block", "shape": "box", "size": [0.2, 0.6, 0.8], "x": 0.55, "y": 0.0, "mass": 100.0}


class Arms:
    """Two arms side by side, moved by hand, with a ball in front of each."""

    def __init__(self) -> None:
        cell = load_cell("duo", ["world.simulator=mujoco", f"world.balls={BALLS}"])
        self.robots = {arm: RobotModel.load(robot) for arm, robot in cell.robots.items()}
        self.world = load_world(cell.world, cell.world.objects, None, cell.robot.gripper)
        assert set(worlds_of(self.world, "mujoco", dict.fromkeys(self.robots)).values()) == {self.world}
        self.q = {arm: robot.named("home") for arm, robot in self.robots.items()}
        self.arms = {arm: self.world.arm(arm, robot, Limits(
            tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration), self.q[arm])
            for arm, robot in self.robots.items()}
        self.now = 0.0

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            for arm in self.arms.values():
                arm.read(self.now)

    def move(self, arm: str, y: float, z: float) -> None:
        start = self.q[arm]
        end = solve_ik(self.robots[arm], tool_down(0.48, y, z), start)
        for s in np.linspace(0.0, 1.0, 100):
            self.arms[arm].write(start + (3 * s**2 - 2 * s**3) * (end - start), 0 * start, self.now)
            self.wait(PERIOD)
        self.q[arm] = end

    def grasp(self, arm: str, y: float) -> None:
        self.move(arm, y, 0.1)
        self.move(arm, y, 0.03)
        self.arms[arm].gripper.command(0.0, self.now, 20.0)
        self.wait(0.8)
        self.move(arm, y, 0.25)

    def states(self) -> dict[str, str]:
        return {obj.id: obj.state for obj in self.world.objects(Header()).objects}


@pytest.fixture
def rig() -> Arms:
    return Arms()


def test_every_link_is_where_its_arm_has_it_and_every_joint_is_read_from_its_own_arm(rig: Arms) -> None:
    rig.move("right", -0.2, 0.3)
    rig.wait(0.3)
    _, data = rig.world.simulation
    for arm, robot in rig.robots.items():
        q, _ = rig.arms[arm].read(rig.now)
        assert q == pytest.approx(rig.q[arm], abs=2e-3)
        fingers = dict.fromkeys(robot.config.gripper.joints, 0.04)
        for link, T in robot.link_poses(q, fingers).items():
            assert data.body(f"{arm}/{link}").xpos == pytest.approx(T[:3, 3], abs=1e-4), (arm, link)
            assert data.body(f"{arm}/{link}").xmat == pytest.approx(T[:3, :3].ravel(), abs=1e-3), (arm, link)


def test_each_gripper_holds_its_own_object_and_only_that_one_is_dropped(rig: Arms) -> None:
    weights = {arm: each.wrench() for arm, each in rig.arms.items()}
    assert weights == {"left": None, "right": None}, "no step was made yet"
    rig.grasp("left", 0.3)
    assert rig.states() == {"ball_1": "held", "ball_2": "table"}
    readings = {arm: each.gripper.read(rig.now) for arm, each in rig.arms.items()}
    assert (readings["left"].holding, readings["right"].holding) == (True, False)
    assert readings["left"].effort == pytest.approx(20.0, rel=0.1)
    rig.grasp("right", -0.3)
    assert rig.states() == {"ball_1": "held", "ball_2": "held"}
    rig.wait(0.3)
    loaded = {arm: float(each.wrench()[2]) for arm, each in rig.arms.items()}
    rig.world.edit(WorldEdit(op="drop", id="ball_2"), rig.now)
    rig.wait(1.0)
    assert rig.states() == {"ball_1": "held", "ball_2": "table"}
    lost = {arm: loaded[arm] - float(each.wrench()[2]) for arm, each in rig.arms.items()}
    assert lost == pytest.approx({"left": 0.0, "right": 0.1 * 9.81}, abs=0.03)  # a ball of 100 g; the tool is down


@pytest.mark.parametrize("between", [{}, {"fixtures": [WALL]}, {"objects": [BLOCK]}], ids=["nothing", "wall", "block"])
def test_arms_sent_into_each_other_touch_unless_something_is_between_them(between: dict[str, object]) -> None:
    table = {"id": "table", "shape": "box", "dimensions": [0.4, 1.0, 0.05], "position": [0.55, 0.0, -0.025]}
    fixtures = [table, *between.get("fixtures", [])]
    world = {"simulator": "mujoco", "fixtures": fixtures, "objects": between.get("objects", [])}
    sim = TwoArms(coordinate=False, world=World.model_validate(world))
    touched = set[str]()
    for name, robot in sim.robots.items():
        q = solve_ik(robot, tool_down(0.55, 0.0, 0.4), robot.named("home"))
        assert q is not None
        sim.execute(name, name, sim.path_to(name, q, 0.3))
    cell, data = sim.physics.simulation

    def note() -> None:
        touched.update(cell.model.body(cell.model.geom_bodyid[geom]).name for geom in data.contact.geom.flat)

    with contextlib.suppress(HardwareFault):  # of an arm at rest that the other one pushes away
        sim.run(6.0, note)
    assert "aborted" in {result.state for result in sim.results.values()}, "an arm cannot go through what is there"
    if between:
        assert sim.contacts == 0 and min(sim.judged()) > 0.1
        assert {name for name in touched if "/" in name} and touched & {"fixture:wall", "object:block"}
    else:
        assert sim.contacts > 10 and -5e-3 < min(sim.judged()) < 1e-3
        assert {name.split("/")[0] for name in touched} == {"left", "right"}
