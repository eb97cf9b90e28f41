"""Velocities follow from detections over time, and from the encoder of a belt where there is one."""

from __future__ import annotations

import numpy as np
import pytest

from common.config import Conveyor
from common.messages import BeltState, ConveyorState, Header
from common.perception.moving import Encoders, MovingEstimate

BELT = Conveyor(dimensions=(2.0, 0.2, 0.05), position=(0.0, 0.0, 0.025), speed=0.1)
NOISE = 0.001  # [m] of detections


def encoders(speeds: list[float], period: float = 0.02) -> Encoders:
    """Return readings of a belt with these speeds in turn."""
    found, position = Encoders({"belt": BELT}), 0.0
    for index, speed in enumerate(speeds):
        found.add(ConveyorState(header=Header(stamp=round((10 + index * period) * 1e9)),
                                belts=[BeltState(name="belt", position=position, speed=speed)]))
        position += speed * period
    return found


def test_line_through_detections_gives_the_velocity_without_an_encoder() -> None:
    rng, estimate = np.random.default_rng(1), MovingEstimate(Encoders({}))
    for time in np.arange(10.0, 11.0, 0.1):
        x, y, z = np.array([0.2 * time, 0.0, 0.07]) + rng.normal(0, NOISE, 3)
        estimate.add(float(time), (x, y, z), 0.04)
    position, velocity = estimate.at(11.0)
    assert velocity == pytest.approx([0.2, 0.0, 0.0], abs=0.005)
    assert position == pytest.approx([2.2, 0.0, 0.07], abs=0.003)


def test_object_that_lies_still_has_no_velocity() -> None:
    rng, estimate = np.random.default_rng(1), MovingEstimate(Encoders({}))
    for time in np.arange(10.0, 11.0, 0.1):
        x, y, z = np.array([0.3, 0.4, 0.02]) + rng.normal(0, NOISE, 3)
        estimate.add(float(time), (x, y, z), 0.04)
    assert estimate.at(11.0)[1].tolist() == [0.0, 0.0, 0.0]


def test_encoder_carries_an_object_on_through_a_change_of_speed_without_images() -> None:
    known, estimate = encoders([0.1] * 25 + [0.2] * 50), MovingEstimate(encoders([]))
    estimate = MovingEstimate(known)
    for time in (10.0, 10.1, 10.2):
        estimate.add(time, (0.1 * (time - 10), 0.0, 0.07), 0.04)
    position, velocity = estimate.at(11.3)
    assert position[0] == pytest.approx(0.05 + 0.2 * 0.8, abs=0.003)
    assert velocity == pytest.approx([0.2, 0.0, 0.0])


def test_object_that_was_moved_by_hand_starts_again() -> None:
    estimate = MovingEstimate(encoders([0.1] * 100))
    for time in (10.0, 10.1, 10.2, 10.3):
        estimate.add(time, (0.1 * (time - 10), 0.0, 0.07), 0.04)
    estimate.add(10.4, (-0.5, 0.05, 0.07), 0.04)
    assert estimate.at(10.4)[0] == pytest.approx([-0.5, 0.05, 0.07])
