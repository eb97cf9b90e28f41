"""Belts carry what lies on them, report their encoder, and behave at their end as configured."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from common.config import World
from common.errors import Refused
from common.messages import ConveyorSet, Header
from common.robot.transforms import tool_down
from common.sim.kinematic import KinematicWorld

CUBE = {"shape": "box", "size": [0.04, 0.04, 0.04]}
BELT = {"dimensions": [1.0, 0.2, 0.1], "position": [0.5, 0.0, 0.05], "speed": 0.2, "acceleration": 1.0}
AWAY = tool_down(0.5, 0.4, 0.4)


def world(*objects: dict[str, Any], **belt: Any) -> KinematicWorld:
    return KinematicWorld(World.model_validate({
        "conveyors": {"belt": {**BELT, **belt}},
        "objects": [{"id": f"object_{n}", **CUBE, **values} for n, values in enumerate(objects)]}))


def run(world: KinematicWorld, begin: float, end: float) -> None:
    for now in np.arange(begin, end + 1e-9, 0.01):
        world.tick(float(now), AWAY, 0.08, False)


def place(world: KinematicWorld, name: str = "object_0") -> list[float]:
    position: list[float] = world.bodies[name].T[:3, 3].tolist()
    return position


@pytest.mark.parametrize(("yaw", "expected"), [(0.0, (0.5, 0.0)), (np.pi / 2, (0.3, 0.2)), (np.pi, (0.1, 0.0))])
def test_belt_carries_an_object_along_its_direction_at_its_speed(yaw: float, expected: tuple[float, float]) -> None:
    one = world({"x": 0.3, "y": 0.0, "z": 0.1}, yaw=yaw, position=[0.3, 0.0, 0.05])
    run(one, 10.0, 11.0)
    assert place(one) == pytest.approx([*expected, 0.12], abs=1e-6)
    assert one.belts.state(Header()).belts[0].position == pytest.approx(0.2)


def test_object_next_to_a_belt_stays_and_one_on_top_of_another_comes_along() -> None:
    one = world({"x": 0.3, "y": 0.0, "z": 0.1}, {"x": 0.3, "y": 0.0, "z": 0.14}, {"x": 0.3, "y": 0.3})
    run(one, 0.0, 1.0)
    assert [place(one, f"object_{n}")[0] for n in range(3)] == pytest.approx([0.5, 0.5, 0.3])


def test_belt_brakes_and_starts_within_its_acceleration() -> None:
    one = world({"x": 0.3, "y": 0.0, "z": 0.1})
    run(one, 0.0, 0.5)
    one.belts.set(ConveyorSet(running=False))
    run(one, 0.51, 2.0)
    belt = one.belts.by_name["belt"]
    assert belt.speed == 0.0
    assert place(one)[0] - 0.3 == pytest.approx(belt.position) == pytest.approx(0.1 + 0.2**2 / 2, abs=3e-3)


@pytest.mark.parametrize("end", ["fall", "wrap", "stop"])
def test_end_of_a_belt(end: str) -> None:
    one = world({"x": 0.7, "y": 0.0, "z": 0.1}, end=end, barrier=0.9)
    run(one, 0.0, 2.0)
    assert one.bodies["object_0"].state == "table"
    at = place(one)
    if end == "fall":
        assert at[0] >= 1.0
        assert at[2] == pytest.approx(0.02)
    elif end == "wrap":
        assert at[0] == pytest.approx(0.1, abs=1e-3)
    else:  # its front is in the light barrier; the belt brakes over 20 mm
        assert at[0] == pytest.approx(0.88 + 0.02, abs=2e-3)
        assert one.belts.by_name["belt"].blocked
        assert one.belts.by_name["belt"].speed == 0.0


def test_stop_of_the_robot_stops_a_belt_once_unless_it_is_to_run() -> None:
    for on_stop, running in (("stop", False), ("run", True)):
        belts = world(on_stop=on_stop).belts
        belts.apply_stop(5)
        assert belts.by_name["belt"].running is running
        belts.set(ConveyorSet(running=True))
        belts.apply_stop(5)
        assert belts.by_name["belt"].running


@pytest.mark.parametrize(("request_", "message"), [
    (ConveyorSet(name="other", running=True), "belt"), (ConveyorSet(speed=0.9), "max_speed, 0.5 m/s")])
def test_bad_request_is_refused_with_the_choices(request_: ConveyorSet, message: str) -> None:
    with pytest.raises(Refused, match=message):
        world().belts.set(request_)


@pytest.mark.parametrize(("values", "message"), [
    ({"speed": 0.9}, "more than max_speed 0.5"), ({"end": "stop"}, "needs a light barrier"),
    ({"barrier": 1.5}, "between 0 and 1")])
def test_bad_configuration_is_one_line(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        world(**values)
