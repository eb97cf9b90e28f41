"""Move an arm to poses of different orientation, measure at rest, and identify its payload."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.client.cell import Cell
from common.client.operator_motion import MotionFailed
from common.client.wrench import TIMEOUT, as_array
from common.control.wrench import Payload, shifted, weight
from common.errors import ConfigError
from common.messages import Wrench
from common.robot.transforms import rpy_to_matrix
from tools.payload.least_squares import LEAST_POSES, Identified, Unidentifiable, gravity_in, identify

Array = NDArray[np.float64]

TILTS = (0.9, 0.7, 0.5, 0.35)  # [rad] of the tool from where it started, tried in this order
MOST_POSES, LEAST_SPEED = 12, 0.01
SETTLE, MEASURE = 0.5, 0.5  # [s] cell time at rest before the measurement, and of its mean
NOISY = 5.0  # [N] standard deviation in a measurement: something touches the tool, or it swings
PLANNING_TIME = 2.0  # [s] wall


def report_lines(found: Identified, flange: str) -> list[str]:
    """Return a payload from the link `flange` for an operator, and the lines of the robot file."""
    x, y, z = (f"{round(value, 4) + 0.0:.4f}" for value in found.com)
    force, torque = found.bias[:3], found.bias[3:]
    return [
        f"mass {found.mass:.3f} kg, uncertain by {_size(found.mass_error, 3)} kg",
        f"centre of mass {x}, {y}, {z} m from {flange}, uncertain by {_size(found.com_error, 4)} m",
        f"sensor bias beyond its zero: force {_vector(force, 2)} N, torque {_vector(torque, 3)} N m",
        f"{found.poses} poses at rest; unexplained: {_size(found.residual[0], 3)} N, {_size(found.residual[1], 4)} N m "
        "(root mean square)",
        "uncertainties are two standard errors of the fit, without what pulls in every pose, such as a cable",
        "in the robot file:",
        "gripper:",
        f"  payload: {{mass: {found.mass:.3f}, com: [{x}, {y}, {z}]}}",
    ]


def _size(value: float, digits: int) -> str:
    least = 10.0**-digits
    return f"less than {least:.{digits}f}" if value < least else f"{value:.{digits}f}"


def _vector(values: Array, digits: int) -> str:
    return ", ".join(f"{round(value, digits) + 0.0:.{digits}f}" for value in values)


def candidates(T: Array) -> list[Array]:
    """Return poses (4, 4) at the place of T (4, 4) with the tool tilted in eight directions, largest tilts first."""
    found = []
    for tilt in TILTS:
        for number in (0, 3, 6, 1, 4, 7, 2, 5):  # the first four or five already point everywhere
            direction = number * math.pi / 4
            turn = rpy_to_matrix(0.0, 0.0, direction)
            tilted = T.copy()
            tilted[:3, :3] = turn @ rpy_to_matrix(tilt, 0.0, 0.0) @ turn.T @ T[:3, :3]
            found.append(tilted)
    return found


def check_request(poses: int, speed: float) -> None:
    """Check the arguments of `identify_payload`.

    Raises:
        ConfigError: one is out of range.
    """
    if not LEAST_POSES <= poses <= MOST_POSES:
        raise ConfigError("--poses", poses, f"must be {LEAST_POSES} to {MOST_POSES}")
    if not LEAST_SPEED <= speed <= 1:
        raise ConfigError("--speed", speed, f"must be {LEAST_SPEED:g} to 1")


async def identify_payload(
    cell: Cell, *, poses: int = 6, speed: float = 0.2, report: Callable[[str], None] = lambda line: None
) -> tuple[Identified, str]:
    """Move the arm to poses of different orientation at its place, measure, and move back to where it started.

    Returns the payload with the name of the flange's link.

    Args:
        cell: joined, its task at rest.
        poses: number of poses, 4 to 12.
        speed: share of the speed limits, up to 1.
        report: called with a line for each pose.

    Raises:
        ConfigError: invalid values.
        NoWrench: the arm has no force sensor.
        MotionFailed: the gripper holds an object, or the arm cannot be moved.
        Unidentifiable: the arm reaches too few orientations here.
    """
    check_request(poses, speed)
    await cell.arm.wrench()
    about = await cell.arm.description()
    if about.gripper and (await cell.gripper.state()).holding:
        raise MotionFailed("holding", "the gripper holds an object: release it first, as its weight would be included")
    start, why = await cell.arm.joints(), ""
    T_tcp_flange = await cell.tf(about.tcp, about.flange)
    rotations: list[Array] = []  # of the flange in world
    wrenches: list[Array] = []  # at the flange
    async with cell.arm.owned():
        for T in [await cell.arm.pose(), *candidates(await cell.arm.pose())]:
            if rotations:
                try:
                    plan = await cell.arm.plan(T, speed=speed, planning_time=PLANNING_TIME)
                except MotionFailed as failed:
                    why = str(failed)
                    continue
                await cell.arm.execute(plan)
            wrench, subtracted = await _measure(cell)
            rotation = (await cell.arm.pose())[:3, :3] @ T_tcp_flange[:3, :3]
            rotations.append(rotation)
            wrenches.append(shifted(wrench, T_tcp_flange) + weight(subtracted, gravity_in([rotation])[0]))
            report(f"pose {len(rotations)} of {poses}: force {_vector(wrenches[-1][:3], 2)} N, torque "
                   f"{_vector(wrenches[-1][3:], 3)} N m at the flange")
            if len(rotations) == poses:
                break
        await cell.arm.move(start, speed=speed)
    if len(rotations) < LEAST_POSES:
        raise Unidentifiable(f"only {len(rotations)} orientations are reachable here: move the arm to a place with "
                             f"more room, such as in front of it, 0.3 m above all objects ({why})")
    return identify(rotations, wrenches), about.flange


async def _measure(cell: Cell) -> tuple[Array, Payload]:
    """Return the mean (6,) of the wrench at rest, and the payload whose weight was subtracted from it."""
    since = cell.bus.header().stamp + int(SETTLE * 1e9)
    found: list[Array] = []
    message = Wrench()
    reader = cell.bus.reader(topics.WRENCH)
    while message.header.stamp < since + MEASURE * 1e9:
        async with asyncio.timeout(TIMEOUT):
            message = await reader.next()
        if message.header.stamp >= since:
            found.append(as_array(message))
    cell.bus.listen(reader, False)
    deviation = float(np.std(found, axis=0)[:3].max())
    if deviation > NOISY:
        raise Unidentifiable(f"the force varies by {deviation:.1f} N at rest: something touches the tool or shakes "
                             "the arm")
    return np.mean(found, axis=0), Payload(message.payload, message.com.x, message.com.y, message.com.z)
