"""Belts in physics carry objects at the speed of the belt, and stop with it."""

from __future__ import annotations

from typing import Any

import pytest

from common.config import World
from common.messages import ConveyorSet
from tests.drivers.mujoco.test_physics import BALL, CUBE, Rig

BELT = {"dimensions": [1.2, 0.25, 0.05], "position": [0.5, 0.0, 0.025], "yaw": 1.5707963267948966}


class BeltRig(Rig):
    """An arm in front of a belt that moves along y."""

    def __init__(self, *objects: dict[str, Any], **belt: Any) -> None:
        self.belt = {**BELT, **belt}
        super().__init__(*({"x": 0.5, "y": -0.3, "z": 0.05, **one} for one in objects))

    def begin(self, q: Any) -> None:
        self.config = World.model_validate({
            **self.config.model_dump(exclude_defaults=True), "conveyors": {"belt": self.belt}})
        super().begin(q)

    def y(self, name: str = "object_1") -> float:
        return float(self.world._kinematic.bodies[name].T[1, 3])


@pytest.mark.parametrize("speed", [0.05, 0.2])
@pytest.mark.parametrize("shape", [CUBE, {"shape": "cylinder", "radius": 0.025, "height": 0.06}])
def test_objects_move_at_the_speed_of_the_belt_within_two_percent(shape: dict[str, Any], speed: float) -> None:
    rig = BeltRig(shape, speed=speed)
    rig.wait(0.5)
    before, encoder = rig.y(), rig.world.belts.by_name["belt"].position
    rig.wait(1.0)
    assert rig.y() - before == pytest.approx(speed, rel=0.02)
    assert rig.world.belts.by_name["belt"].position - encoder == pytest.approx(speed, rel=1e-3)


def test_ball_on_a_belt_is_moved_by_it() -> None:
    rig = BeltRig(BALL, speed=0.1)
    rig.wait(1.0)
    assert rig.y() > -0.29


def test_object_stops_with_the_belt_and_comes_again_at_its_start() -> None:
    rig = BeltRig({**CUBE, "y": 0.35}, speed=0.2, end="wrap")
    rig.wait(1.6)
    assert rig.y() < 0.0
    rig.world.belts.set(ConveyorSet(running=False))
    rig.wait(1.0)
    before = rig.y()
    rig.wait(0.5)
    assert rig.y() == pytest.approx(before, abs=1e-3)
