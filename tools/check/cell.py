"""All that is looked at in a cell, in two parts: what is quick, and what has a robot's model loaded for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from common.application import find_application
from common.config import Cell, Surroundings
from common.errors import ConfigError
from common.hardware.loading import is_simulated
from common.sim.interface import require_simulator
from tools.check.finding import Finding, refusal

if TYPE_CHECKING:
    from common.robot.model import RobotModel


def refused(cell: Cell) -> list[Finding]:
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
    for found in refused(cell):
        field, _, rest = found.line.partition(": ")
        raise ConfigError(field, ..., rest)


def doubts(cell: Cell) -> list[Finding]:
    """What else will not work, as far as it is told quickly."""
    return [found for found in quick(cell) if not found.refused]


def quick(cell: Cell) -> list[Finding]:
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
    from common.perception.mounted import from_home
    from common.robot.model import RobotModel

    return cell.model_copy(update={"world": from_home(cell.world, robot or RobotModel.load(cell.robot))})


def thorough(cell: Cell) -> Iterator[Finding]:
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
