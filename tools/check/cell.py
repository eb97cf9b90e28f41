"""Checks of a cell: from its files within milliseconds, and with a model of its robot."""

from __future__ import annotations

import asyncio
import pickle
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
    """Return errors of the robot file with which nothing may start; takes milliseconds.

    Errors that services find when they start are left out: parameters, joints and links of the robot, keys with two
    owners, and collisions at the home pose.
    """
    from tools.check.robot_file import check_robot_file

    try:
        return [found for found in check_robot_file(cell.robot) if found.refused]
    except ConfigError:  # a service reports it
        return []


def require_safe(cell: Cell) -> None:
    """Return if the arm and its fingers would move correctly as far as the files show.

    Raises:
        ConfigError: they would not, with the finding of `zencell check`; or the simulator is not usable.
        UnknownName: the simulator does not exist.
    """
    if is_simulated(cell.robot):
        require_simulator(cell.world.simulator)
    for found in blocking_errors(cell):
        field, _, rest = found.line.partition(": ")
        raise ConfigError(field, ..., rest)


def quick_warnings(cell: Cell) -> list[Finding]:
    """Return the findings of `check_files` with which the cell still starts."""
    return [found for found in check_files(cell) if not found.refused]


def check_files(cell: Cell) -> list[Finding]:
    """Return findings from the files; the robot model is loaded only for a camera on the arm."""
    from tools.check.robot_file import check_robot_file
    from tools.check.world import check_world

    of_robot = _collect(lambda: check_robot_file(cell.robot))
    try:
        seen = seen_from_home(cell)
    except ConfigError as problem:
        return [*of_robot, refusal(problem)]
    checks = find_application(cell.application).checks
    place = " from home" if cell.world.on_hand else ""
    return [*of_robot, *_collect(lambda: check_world(seen, find_application(cell.application), place)),
            *_of_application(checks.quick if checks else None, seen)]


def seen_from_home(cell: Cell, robot: RobotModel | None = None) -> Cell:
    """Return the cell with cameras on the arm fixed where they are at the home pose.

    Raises:
        ConfigError: the robot file does not fit its description, or has no such link.
    """
    if not cell.world.on_hand:
        return cell
    from common.perception.pinhole import cameras_at_home
    from common.robot.model import RobotModel

    return cell.model_copy(update={"world": cameras_at_home(cell.world, robot or RobotModel.load(cell.robot))})


def check_model(cell: Cell) -> Iterator[Finding]:
    """Yield findings that need the robot model."""
    from tools.check.arm import Arm

    try:
        arm = Arm(cell.robot, cell.section(Surroundings))  # type: ignore[arg-type]
    except ConfigError as problem:
        yield refusal(problem)
        return
    yield from arm.check_poses()
    checks = find_application(cell.application).checks
    yield from _of_application(checks.reach if checks else None, seen_from_home(cell, arm.robot), arm)


def _of_application(check: Callable[..., Iterator[Finding]] | None, *args: object) -> list[Finding]:
    return _collect(lambda: check(*args)) if check is not None else []


def _collect(check: Callable[[], Iterator[Finding]]) -> list[Finding]:
    """Return the findings of a check; a configuration error that ends it is one more."""
    found: list[Finding] = []
    try:
        found.extend(check())
    except ConfigError as problem:
        found.append(refusal(problem))
    return found


# --- quick checks in a subprocess, whose imports, half a planner, are gone afterwards ---------------------------------


NICE = 10  # the services have priority


class QuickCheckFailed(ZencellError):
    """The subprocess failed."""


async def warnings_in_subprocess(cell: Cell, environ: Mapping[str, str]) -> list[Finding]:
    """Return `quick_warnings` of a cell, computed in a subprocess that ends with the call.

    Args:
        cell: as it was loaded.
        environ: of the subprocess; its PYTHONPATH has the modules that the cell names.

    Raises:
        QuickCheckFailed: the subprocess failed; stderr has its output.
    """
    process = await asyncio.create_subprocess_exec(
        *module_command("tools.check.quick"), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        env=environ, start_new_session=True,  # so that it does not get Ctrl-C
    )
    try:
        output, _ = await process.communicate(pickle.dumps(cell))
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode:
        raise QuickCheckFailed(f"the quick check failed (exit code {process.returncode}); see `zencell check`")
    found: list[Finding] = pickle.loads(output)
    return found
