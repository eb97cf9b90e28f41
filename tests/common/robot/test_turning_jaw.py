"""Where the joint of a jaw is that turns towards a fixed finger."""

from __future__ import annotations

import pytest

from common.config import GripperConfig, check
from common.errors import ConfigError
from common.robot.finger_joints import driven_position, finger_velocities, width_at

GIVEN = {"joints": ["jaw"], "links": ["tip"], "max_width": 0.07}


def gripper(opens: int, **values: object) -> GripperConfig:
    jaw = {"radius": 0.08, "angle": -0.3, "closed": 0.2, "opens": opens}
    return check(GripperConfig, GIVEN | {"jaw": jaw} | values, "gripper")


@pytest.mark.parametrize("opens", [1, -1])
@pytest.mark.parametrize("width", [0.0, 0.02, 0.05, 0.07])
def test_widths_and_positions_belong_to_each_other(opens: int, width: float) -> None:
    one = gripper(opens)
    at = driven_position(one, width)
    assert width_at(one, at) == pytest.approx(width) and opens * (at - 0.2) >= 0.0
    after, before = driven_position(one, width + 1e-5), driven_position(one, width - 1e-5)
    assert finger_velocities(one, width, 0.1) == [pytest.approx(0.1 * (after - before) / 2e-5, rel=1e-3)]


@pytest.mark.parametrize(("wrong", "told"), [
    ({"max_width": 0.2}, "gripper.jaw opens by 0.1036 m at most, max_width is 0.2 m"),
    ({"closed": 0.1}, "gripper.closed is of fingers that slide"),
    ({"joints": ["jaw", "other"]}, "gripper.jaw is of one joint"),
])
def test_a_jaw_that_cannot_be_is_told(wrong: dict[str, object], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        gripper(1, **wrong)
