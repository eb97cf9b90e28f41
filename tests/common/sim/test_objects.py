from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from common.config import ObjectConfig
from common.sim.objects import world_object


def area(outline: list[tuple[float, float]]) -> float:
    x, y = np.array(outline).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


@pytest.mark.parametrize(("options", "expected"), [
    ({"shape": "box", "size": (0.1, 0.2)}, 0.02),
    ({"shape": "cylinder", "radius": 0.05}, math.pi * 0.0025),
    ({"shape": "prism", "polygon": [(0, 0), (0, 0.1), (0.1, 0)]}, 0.005),
])
def test_outline_is_counterclockwise_with_the_area_of_the_shape(options: dict[str, object], expected: float) -> None:
    thing = ObjectConfig.model_validate({"id": "thing", "x": 0.5, "y": 0.1, "yaw": 0.4, "height": 0.1, **options})
    assert area(world_object(thing).outline) == pytest.approx(expected, rel=1e-3)


def test_yaw_rotates_counterclockwise_about_the_position() -> None:
    thing = ObjectConfig(id="box", shape="box", size=(0.2, 0.1), x=0.5, y=0.1, yaw=math.pi / 2, height=0.1)
    assert np.array(world_object(thing).outline)[1] == pytest.approx([0.55, 0.2])


def test_ring_has_a_hole() -> None:
    ring = world_object(ObjectConfig(id="ring", shape="ring", radius=0.06, inner_radius=0.04, x=0, y=0, height=0.03))
    assert np.hypot(*np.array(ring.hole).T) == pytest.approx(0.04)


def test_shape_without_its_dimensions_is_rejected() -> None:
    with pytest.raises(ValidationError, match="ring needs radius and inner_radius"):
        ObjectConfig(id="ring", shape="ring", x=0, y=0, height=0.03)
