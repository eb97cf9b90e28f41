"""The rules by which is guessed what a URDF does not say of a joint."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import ConfigError
from tools.robot_setup.tree import Joint, guessed_acceleration, guessed_jerk, position_range


def joint(kind: str, lower: float | None = None, upper: float | None = None) -> Joint:
    return Joint("j", kind, "a", "b", lower, upper)


@given(st.floats(0.05, 20))
def test_a_joint_comes_to_its_speed_in_half_a_second_and_to_that_acceleration_in_a_twentieth(speed: float) -> None:
    acceleration = guessed_acceleration(speed)
    assert speed / acceleration == pytest.approx(0.5, rel=0.01)
    assert acceleration / guessed_jerk(acceleration) == pytest.approx(0.05, rel=0.01)


def test_a_joint_that_turns_on_and_on_gets_half_a_turn_either_way() -> None:
    assert position_range(joint("continuous")) == (-math.pi, math.pi, True)
    assert position_range(joint("continuous", -6.3, 6.3)) == (-math.pi, math.pi, True)
    assert position_range(joint("revolute", -2 * math.pi, 2 * math.pi)) == (-math.pi, math.pi, True)


@pytest.mark.parametrize(("kind", "low", "high"), [
    ("revolute", -math.pi, math.pi), ("revolute", 0.3, 6.0), ("revolute", -0.1, 7.0), ("prismatic", 0.0, 9.0)])
def test_limits_within_a_turn_or_to_one_side_are_those_of_the_urdf(kind: str, low: float, high: float) -> None:
    assert position_range(joint(kind, low, high)) == (low, high, False)


@pytest.mark.parametrize(("low", "high"), [(None, None), (0.0, 0.0), (1.0, -1.0), (None, 1.0)])
def test_a_joint_with_ends_must_say_where_they_are(low: float | None, high: float | None) -> None:
    with pytest.raises(ConfigError, match="'j' is revolute and needs limits"):
        position_range(joint("revolute", low, high))
