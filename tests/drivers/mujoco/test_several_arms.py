"""Two arms in one world with physics: each has its own servos, fingers and sensor, and they touch each other."""

import contextlib
from typing import Any

import pytest

from common.config import World
from common.hardware.interface import HardwareFault
from common.messages import Header, WorldEdit
from common.planning.ik import solve_ik
from common.robot.transforms import tool_down
from tests.two_arms import TwoArms

TABLE = {"id": "table", "shape": "box", "dimensions": [0.4, 1.0, 0.05], "position": [0.55, 0.0, -0.025]}
PLACES = {"left": (0.45, 0.2), "right": (0.65, -0.2)}
BALLS = [{"id": arm, "shape": "sphere", "radius": 0.03, "x": x, "y": y, "mass": 0.1} for arm, (x, y) in PLACES.items()]
WALL = {"id": "wall", "shape": "box", "dimensions": [0.2, 0.8, 1.2], "position": [0.55, 0.0, 0.2]}
BLOCK = {"id": "block", "shape": "box", "size": [0.2, 0.6, 0.8], "x": 0.55, "y": 0.0, "mass": 100.0}


def two_arms(*objects: dict[str, Any], fixtures: tuple[dict[str, Any], ...] = ()) -> TwoArms:
    return TwoArms(coordinate=False, world=World.model_validate(
        {"simulator": "mujoco", "fixtures": [TABLE, *fixtures], "objects": objects}))


def send(sim: TwoArms, arm: str, x: float, y: float, z: float) -> str:
    q, goal = solve_ik(sim.robots[arm], tool_down(x, y, z), sim.arms[arm].q), f"{arm} at {sim.now}"
    sim.execute(arm, goal, sim.path_to(arm, q))
    return goal


def grasp(sim: TwoArms, arm: str) -> None:
    for z in (0.1, 0.03, 0.25):
        goal = send(sim, arm, *PLACES[arm], z)
        while not sim.results[goal].state:
            sim.run(0.1)
        if z == 0.03:
            sim.arms[arm].hardware.gripper.command(0.0, sim.now, 20.0)
            sim.run(0.8)


def states(sim: TwoArms) -> dict[str, str]:
    return {obj.id: obj.state for obj in sim.physics.objects(Header()).objects}


def test_every_link_is_where_its_arm_has_it_and_every_joint_is_read_from_its_own_arm() -> None:
    sim = two_arms()
    goal = send(sim, "right", 0.7, 0.2, 0.3)
    while not sim.results[goal].state:
        sim.run(0.5)
    _, data = sim.physics.simulation
    for arm, robot in sim.robots.items():
        q = sim.arms[arm].measured
        assert q == pytest.approx(sim.arms[arm].q, abs=1e-3)
        for link, T in robot.link_poses(q, dict.fromkeys(robot.config.gripper.joints, 0.04)).items():
            assert data.body(f"{arm}/{link}").xpos == pytest.approx(T[:3, 3], abs=1e-3), (arm, link)
            assert data.body(f"{arm}/{link}").xmat == pytest.approx(T[:3, :3].ravel(), abs=1e-3), (arm, link)


def test_each_gripper_holds_and_each_sensor_weighs_its_own_object() -> None:
    sim = two_arms(*BALLS)
    grasp(sim, "left")
    hardware = {name: arm.hardware for name, arm in sim.arms.items()}
    assert states(sim) == {"left": "held", "right": "table"}
    readings = {arm: each.gripper.read(sim.now) for arm, each in hardware.items()}
    assert (readings["left"].holding, readings["right"].holding) == (True, False)
    assert readings["left"].effort == pytest.approx(20.0, rel=0.1)
    grasp(sim, "right")
    sim.run(0.3)
    assert states(sim) == {"left": "held", "right": "held"}
    loaded = {arm: float(each.wrench()[2]) for arm, each in hardware.items()}
    sim.physics.edit(WorldEdit(op="drop", id="right"), sim.now)
    sim.run(1.0)
    assert states(sim) == {"left": "held", "right": "table"}
    lost = {arm: loaded[arm] - float(each.wrench()[2]) for arm, each in hardware.items()}
    assert lost == pytest.approx({"left": 0.0, "right": 0.1 * 9.81}, abs=0.03)  # the tools point down
    assert sim.contacts == 0, "an object between fingers is no contact between the arms"


@pytest.mark.parametrize("between", [(), (WALL,), (BLOCK,)], ids=["nothing", "wall", "block"])
def test_arms_sent_into_each_other_touch_unless_something_is_between_them(between: tuple[dict[str, Any], ...]) -> None:
    sim = two_arms(fixtures=between) if between == (WALL,) else two_arms(*between)
    goals, touched = [send(sim, arm, 0.55, 0.0, 0.4) for arm in sim.arms], set[str]()
    cell, data = sim.physics.simulation
    with contextlib.suppress(HardwareFault):  # of an arm at rest that the other one pushes away
        sim.run(5.0, lambda: touched.update(
            cell.model.body(cell.model.geom_bodyid[geom]).name for geom in data.contact.geom.flat))
    assert [sim.results[goal].state for goal in goals] != ["succeeded"] * 2
    if between:
        assert sim.contacts == 0 and min(sim.judged()) > 0.1
        assert touched & {"fixture:wall", "object:block"} and any("/" in name for name in touched)
    else:
        assert sim.contacts > 10 and -5e-3 < min(sim.judged()) < 1e-3  # bodies in contact sink in a little
        assert {name.split("/")[0] for name in touched} == {"left", "right"}
