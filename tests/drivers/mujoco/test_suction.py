"""A suction cup in physics: it holds by adhesion, up to a weight and an acceleration."""

import pytest

from common.config import World, load_cell
from common.robot.model import RobotModel
from tests.drivers.mujoco.test_physics import Rig

BLOCK = {"shape": "box", "size": [0.06, 0.06, 0.05], "mass": 0.5}
TOP = 0.05


class CupRig(Rig):
    """A UR5 with a cup that pulls with 42 N."""

    def __init__(self, *objects: dict[str, object]) -> None:
        config = load_cell("panda", ["robot=ur5_cup", "robot.base_position=[0.0, 0.0, 0.4]"])
        self.robot = RobotModel.load(config.robot)
        found = [{"id": f"object_{i + 1}", "x": 0.45, "y": 0.0, **obj} for i, obj in enumerate(objects)]
        self.config = World.model_validate({
            "fixtures": [{"id": "table", "dimensions": [1.0, 1.0, 0.05], "position": [0.5, 0.0, -0.025]}],
            "objects": found, "simulator": "mujoco"})
        self.now = 100.0
        self.begin(self.robot.named("home"))

    def draw(self, z: float, x: float = 0.45) -> None:
        """Put the lip at a height, open the valve and lift."""
        self.move(self.above(x, 0.0, z + 0.07))
        self.move(self.above(x, 0.0, z))
        self.grip(0.0)
        self.move(self.above(x, 0.0, 0.25), seconds=2.0)

    @property
    def holding(self) -> bool:
        return self.fingers.read(self.now).holding


def test_object_is_held_while_the_valve_is_open_and_comes_to_rest_after_it_is_closed() -> None:
    rig = CupRig(BLOCK)
    rig.move(rig.above(0.45, 0.0, TOP + 0.07))
    rig.move(rig.above(0.45, 0.0, TOP))
    assert not rig.holding and rig.object().state == "table", "contact alone does not hold"
    rig.draw(TOP)
    assert rig.holding and rig.object().state == "held" and rig.position()[2] == pytest.approx(0.223, abs=2e-3)
    assert [update.data for update in rig.world.take_events()] == ["remove:object_1"]
    rig.move(rig.above(0.5, 0.2, 0.1))
    rig.grip(0.08)
    assert not rig.holding and rig.object().state == "table"
    assert rig.position() == pytest.approx((0.5, 0.2, 0.025), abs=5e-3)
    assert [update.data for update in rig.world.take_events()] == ["add:object_1"]


@pytest.mark.parametrize(("mass", "seconds", "holds"), [
    (4.0, 2.0, True), (4.6, 2.0, False),  # 39 N and 45 N
    (3.0, 1.0, True), (3.0, 0.3, False),  # a fast motion sideways tears the object off
])
def test_weight_and_acceleration_limit_what_the_cup_carries(mass: float, seconds: float, holds: bool) -> None:
    rig = CupRig({**BLOCK, "mass": mass})
    rig.draw(TOP)
    rig.move(rig.above(0.45, 0.25, 0.25), seconds)
    assert rig.holding is holds
    assert (rig.position()[2] > 0.2) is holds, "what is lost falls"


@pytest.mark.parametrize(("shape", "x", "z", "reason"), [
    ({**BLOCK, "size": [0.02, 0.02, 0.05]}, 0.45, TOP, "object_1: the surface is smaller than the lip, 30 mm"),
    (BLOCK, 0.47, TOP, "object_1: the surface is smaller than the lip, 30 mm, or the cup is at its edge"),
    ({"shape": "sphere", "radius": 0.016}, 0.45, 0.032, "object_1: the surface is not flat: 10.5 mm under the lip"),
    (BLOCK, 0.45, TOP + 0.01, "object_1: the lip is up to 10.0 mm above the surface, and gives 4 mm"),
    (BLOCK, 0.45, TOP + 0.05, "nothing is at the cup"),
])
def test_cup_that_does_not_seal_says_why(shape: dict[str, object], x: float, z: float, reason: str) -> None:
    rig = CupRig(shape)
    rig.move(rig.above(x, 0.0, z + 0.07))
    rig.move(rig.above(x, 0.0, z))
    rig.grip(0.0)
    reading = rig.fingers.read(rig.now)
    assert not reading.holding and reading.width == 0.0 and reading.message.startswith(reason)


def test_held_object_stays_at_the_cup_over_a_restart() -> None:
    rig = CupRig(BLOCK)
    rig.draw(TOP)
    before = rig.position()
    rig.restart()
    rig.fingers.command(0.0, rig.now, 5.0)  # the executor resumes the newest command
    rig.wait(0.5)
    assert rig.holding and rig.position() == pytest.approx(before, abs=2e-3)
