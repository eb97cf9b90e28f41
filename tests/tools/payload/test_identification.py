"""Identification of a payload: pure least squares, and a complete cell in physics."""

import numpy as np
import pytest

from common.client.cell import Cell
from common.client.operator_motion import MotionFailed
from common.client.wrench import NoWrench
from common.control.wrench import Payload, weight
from common.robot.transforms import rpy_to_matrix
from tests.client.simulated_cell import run
from tools.payload.least_squares import Unidentifiable, gravity_in, identify
from tools.payload.measurement import candidates, identify_payload, report_lines

BIAS = np.array([3.0, -1.0, 2.0, 0.1, -0.2, 0.3])
LOADS = [Payload(0.2, 0.0, 0.0, 0.02), Payload(1.4, 0.02, -0.03, 0.12), Payload(5.0, -0.1, 0.05, 0.2)]


def measured(load: Payload, poses: int, noise: float = 0.0, seed: int = 0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return orientations that the tool tilts to, and readings of a biased sensor; noise in [N] and [0.1 N m]."""
    T, rng = np.eye(4), np.random.default_rng(seed)
    T[:3, :3] = rpy_to_matrix(np.pi, 0.0, 0.3)
    rotations = [pose[:3, :3] for pose in [T, *candidates(T)][:poses]]
    scale = noise * np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    return rotations, [weight(load, gravity) + BIAS + rng.normal(0.0, 1.0, 6) * scale
                       for gravity in gravity_in(rotations)]


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("poses", [4, 6, 12])
def test_payload_and_bias_are_found_exactly_without_noise(load: Payload, poses: int) -> None:
    found = identify(*measured(load, poses))
    assert found.mass == pytest.approx(load.mass) and found.com == pytest.approx(load.com)
    assert found.bias == pytest.approx(BIAS) and found.poses == poses
    assert max(found.mass_error, found.com_error, *found.residual) < 1e-6


def test_uncertainty_covers_the_error_in_about_95_of_100_cases() -> None:
    load, within = LOADS[1], []
    for seed in range(300):
        found = identify(*measured(load, 6, noise=0.3, seed=seed))
        within.append((abs(found.mass - load.mass) < found.mass_error,
                       np.abs(found.com - load.com).max() < found.com_error))
    assert np.mean(within, axis=0).min() > 0.85 and np.mean(within, axis=0)[0] < 0.99


@pytest.mark.parametrize("rotations, why", [
    ([np.eye(3)] * 3, "3 poses are too few: 4"),
    ([rpy_to_matrix(0.0, 0.0, yaw) for yaw in range(6)], "too much alike"),
    ([rpy_to_matrix(tilt, 0.0, 0.0) for tilt in (0.0, 0.4, 0.8, -0.4, -0.8)], "too much alike"),
    ([rpy_to_matrix(0.05 * roll, 0.05 * pitch, 0.0) for roll in (-1, 1) for pitch in (-1, 1)], "too much alike"),
])
def test_poses_that_do_not_determine_the_payload_are_rejected(rotations: list[np.ndarray], why: str) -> None:
    with pytest.raises(Unidentifiable, match=why):
        identify(rotations, [weight(LOADS[1], gravity) for gravity in gravity_in(rotations)])


def test_flange_without_a_weight_is_reported() -> None:
    with pytest.raises(Unidentifiable, match="no weight was measured"):
        identify(*measured(Payload(), 6, noise=0.2))


def test_arm_without_a_sensor_is_not_moved() -> None:
    async def program(cell: Cell) -> None:
        before = await cell.arm.joints()
        with pytest.raises(NoWrench, match="no force sensor"):
            await identify_payload(cell)
        assert np.array_equal(await cell.arm.joints(), before)

    run(program)


@pytest.mark.slow
def test_payload_of_the_simulated_gripper_is_found_and_the_arm_returns() -> None:
    pytest.importorskip("mujoco")

    async def program(cell: Cell) -> None:
        before, lines = await cell.arm.joints(), list[str]()
        found, flange = await identify_payload(cell, poses=4, speed=0.5, report=lines.append)
        assert np.allclose(await cell.arm.joints(), before, atol=2e-3) and len(lines) == 4
        assert found.mass == pytest.approx(0.76, rel=0.01)  # hand and fingers in the URDF
        assert found.com == pytest.approx([-0.0068, 0.0068, 0.0311], abs=5e-4)
        assert flange == "panda_link8"
        assert report_lines(found, flange)[-1] == "  payload: {mass: 0.760, com: [-0.0068, 0.0068, 0.0312]}"
        await cell.arm.zero_wrench()
        assert np.abs(await cell.arm.wrench()).max() < 0.1
        with pytest.raises(MotionFailed):
            await cell.arm.move([0.0] * 7)

    run(program, "panda", "world.simulator=mujoco", "world.count=0", "robot.gripper.payload={mass: 0}")
