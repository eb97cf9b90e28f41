"""Mass, centre of mass and sensor bias from wrenches at rest in several orientations.

At rest a sensor reads f = m g + b and t = c x m g + d, linear in m, b, m c and d. Gravity g is along the sensor's own
axes, which differ from pose to pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.control.wrench import GRAVITY
from common.errors import ZencellError

Array = NDArray[np.float64]

LEAST_POSES = 4
SPREAD = 0.3  # second singular value of the directions of gravity: poses that differ less do not determine the payload
COVERAGE = 2.0  # standard errors of the uncertainty that is reported: about 95 %


class Unidentifiable(ZencellError):
    """The measurements do not determine the payload."""

    exit_code = 1


@dataclass(frozen=True)
class Identified:
    """A payload from the flange, along its axes.

    Attributes:
        mass: [kg], with the uncertainty `mass_error`.
        com: centre of mass (3,) [m], with the uncertainty `com_error` of its worst component.
        bias: of the sensor (6,) [N], [N m].
        residual: root mean square of what the model does not explain: force [N], torque [N m].
        poses: number of poses.
    """

    mass: float
    mass_error: float
    com: Array
    com_error: float
    bias: Array
    residual: tuple[float, float]
    poses: int


def gravity_in(rotations: Sequence[Array]) -> Array:
    """Return gravity (n, 3) [m/s^2] along the axes of frames with rotations (3, 3) in world."""
    return np.array([rotation.T @ [0.0, 0.0, -GRAVITY] for rotation in rotations])


def spread(rotations: Sequence[Array]) -> float:
    """Return how much the directions of gravity differ in the second of the directions in which they do.

    Directions in one plane would leave the centre of mass along the normal of the plane undetermined.
    """
    directions = gravity_in(rotations) / GRAVITY
    return float(np.linalg.svd(directions - directions.mean(axis=0), compute_uv=False)[1])


def identify(rotations: Sequence[Array], wrenches: Sequence[Array]) -> Identified:
    """Return the payload that explains wrenches (6,) [N], [N m] at rest best.

    Args:
        rotations: (3, 3) of the flange in world, for each pose.
        wrenches: what acts on the flange, along its axes.

    Raises:
        Unidentifiable: too few poses, poses too much alike, or there is no weight.
    """
    count = len(rotations)
    if count < LEAST_POSES:
        raise Unidentifiable(f"{count} poses are too few: {LEAST_POSES} are needed")
    if (found := spread(rotations)) < SPREAD:
        raise Unidentifiable(f"the poses are too much alike: the directions of gravity differ by {found:.2f}, and "
                             f"{SPREAD:g} is needed; start where the tool can be tilted in every direction")
    gravity, measured = gravity_in(rotations), np.array(wrenches)
    same = np.tile(np.eye(3), (count, 1))
    (mass, *bias), (mass_error, *_), force_residual = _solve(
        np.hstack([gravity.reshape(-1, 1), same]), measured[:, :3].ravel())
    moment, errors, torque_residual = _solve(
        np.hstack([np.concatenate([-_skew(each) for each in gravity]), same]), measured[:, 3:].ravel())
    if abs(mass) < 3 * mass_error or abs(mass) < 1e-6:
        raise Unidentifiable(f"no weight was measured: {mass:.3f} kg, uncertain by {COVERAGE * mass_error:.3f} kg")
    com = moment[:3] / mass
    com_error = float(np.hypot(errors[:3].max(), np.abs(com).max() * mass_error) / abs(mass))
    return Identified(float(mass), COVERAGE * float(mass_error), com, COVERAGE * com_error,
                      np.array([*bias, *moment[3:]]), (force_residual, torque_residual), count)


def _solve(system: Array, measured: Array) -> tuple[Array, Array, float]:
    """Return the solution, its standard errors, and the root mean square of the residual."""
    solution = np.asarray(np.linalg.lstsq(system, measured, rcond=None)[0], np.float64)
    left = measured - system @ solution
    variance = float(left @ left) / (len(measured) - len(solution))
    errors: Array = np.sqrt(variance * np.diag(np.linalg.inv(system.T @ system)))
    return solution, errors, float(np.sqrt(np.mean(left**2)))


def _skew(v: Array) -> Array:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
