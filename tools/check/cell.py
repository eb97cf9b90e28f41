"""Checks of a cell: from its files within milliseconds, and with a model of its robot."""

from __future__ import annotations

import asyncio
import os
import pickle
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

from common.application import find_application
from common.config import Cell, Surroundings
from common.errors import ConfigError, ZencellError
from common.hardware.loading import is_simulated
from common.sim.interface import require_simulator
from common.supervision.launch import module_command
from tools.check import Finding, refusal

if TYPE_CHECKING:
    from common.robot.model import RobotModel


def blocking_errors(cell: Cell) -> list[Finding]:
    """What nothing may begin with, as far as the robot file tells it: within milliseconds.

    What services refuse by themselves as they come up is left to them: their parameters, joints and links of the
    robot, keys that two of them own, and an arm that touches something at home.
    """
    from tools.check.robot_file import check_robot_file

    try:
        return [found for found in check_robot_file(cell.robot) if found.refused]
    except ConfigError:  # a service says it
        return []


def require_safe(cell: Cell) -> None:
    """Return when nothing is known because of which the arm or its fingers would move wrongly.

    Raises:
        ConfigError: something is; as `zencell check` says it. Or the simulator cannot simulate.
        UnknownName: there is no such simulator.
    """
    if is_simulated(cell.robot):
        require_simulator(cell.world.simulator)
    for found in blocking_errors(cell):
        field, _, rest = found.line.partition(": ")
        raise ConfigError(field, ..., rest)


def quick_warnings(cell: Cell) -> list[Finding]:
    """What else will not work, as far as it is told quickly."""
    return [found for found in check_files(cell) if not found.refused]


def check_files(cell: Cell) -> list[Finding]:
    """What the files tell; a model of the robot is loaded only to see where a camera on it looks from home."""
    from tools.check.robot_file import check_robot_file
    from tools.check.world import check_world

    of_robot = _each(lambda: check_robot_file(cell.robot))
    try:
        seen = seen_from_home(cell)
    except ConfigError as told:
        return [*of_robot, refusal(told)]
    checks = find_application(cell.application).checks
    place = " from home" if cell.world.on_hand else ""
    return [*of_robot, *_each(lambda: check_world(seen, find_application(cell.application), place)),
            *_of_application(checks.quick if checks else None, seen)]


def seen_from_home(cell: Cell, robot: RobotModel | None = None) -> Cell:
    """The cell with cameras on the robot fixed where they are at home.

    Raises:
        ConfigError: the robot file does not fit its description, or has no such link.
    """
    if not cell.world.on_hand:
        return cell
    from common.perception.pinhole import cameras_at_home
    from common.robot.model import RobotModel

    return cell.model_copy(update={"world": cameras_at_home(cell.world, robot or RobotModel.load(cell.robot))})


def check_model(cell: Cell) -> Iterator[Finding]:
    """What it takes a model of the robot to tell."""
    from tools.check.arm import Arm

    try:
        arm = Arm(cell.robot, cell.section(Surroundings))  # type: ignore[arg-type]
    except ConfigError as told:
        yield refusal(told)
        return
    yield from arm.check_poses()
    checks = find_application(cell.application).checks
    yield from _of_application(checks.reach if checks else None, seen_from_home(cell, arm.robot), arm)


def _of_application(check: Callable[..., Iterator[Finding]] | None, *args: object) -> list[Finding]:
    return _each(lambda: check(*args)) if check is not None else []


def _each(look: Callable[[], Iterator[Finding]]) -> list[Finding]:
    """What a look finds; an error of the configuration on the way is one more."""
    found: list[Finding] = []
    try:
        found.extend(look())
    except ConfigError as told:
        found.append(refusal(told))
    return found


NICE = 10  # the cell goes first


class QuickCheckFailed(ZencellError):
    """The process ended without a word of what it found."""


async def warnings_in_subprocess(cell: Cell, environ: Mapping[str, str]) -> list[Finding]:
    """What will not work in a cell, as `tools.check.cell.quick_warnings` tells it; the process dies with the call.

    Args:
        cell: as it was loaded.
        environ: of the process; its PYTHONPATH leads to what the cell names.

    Raises:
        QuickCheckFailed: it failed; what it said of that is on stderr.
    """
    process = await asyncio.create_subprocess_exec(
        *module_command(__name__), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, env=environ,
        start_new_session=True,  # Ctrl-C is for us
    )
    try:
        told, _ = await process.communicate(pickle.dumps(cell))
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode:
        raise QuickCheckFailed(f"the quick check failed (exit code {process.returncode}); see `zencell check`")
    found: list[Finding] = pickle.loads(told)
    return found


def main() -> None:
    """Look at the cell from stdin."""
    from common.process.lifeline import die_when_orphaned

    die_when_orphaned()
    os.nice(NICE)
    with os.fdopen(os.dup(1), "wb") as answer:
        os.dup2(2, 1)  # what a module of a person's own prints is no part of the answer
        from tools.check.cell import quick_warnings  # not of __main__: Finding is unpickled by this name

        answer.write(pickle.dumps(quick_warnings(pickle.load(sys.stdin.buffer))))


if __name__ == "__main__":
    main()
