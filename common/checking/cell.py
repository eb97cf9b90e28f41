"""All that is looked at in a cell, in two parts: what is quick, and what has a robot's model loaded for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from common.application import find_application
from common.checking.finding import Finding, refusal
from common.config import Cell, Surroundings
from common.errors import ConfigError


def refused(cell: Cell) -> list[Finding]:
    """What nothing may begin with, as far as the robot file tells it: within milliseconds.

    What services refuse by themselves as they come up is left to them: their parameters, joints and links of the
    robot, keys that two of them own, and an arm that touches something at home.
    """
    from common.checking.robot_file import check_robot_file

    try:
        return [found for found in check_robot_file(cell.robot) if found.refused]
    except ConfigError:  # a service says it
        return []


def quick(cell: Cell) -> list[Finding]:
    """What the files tell without a model of the robot."""
    from common.checking.robot_file import check_robot_file
    from common.checking.world import check_world

    return [*_each(lambda: check_robot_file(cell.robot)),
            *_each(lambda: check_world(cell, find_application(cell.application))), *_of_application(cell, "quick")]


def thorough(cell: Cell) -> Iterator[Finding]:
    """What it takes a model of the robot to tell."""
    from common.checking.arm import Arm

    try:
        arm = Arm(cell.robot, cell.section(Surroundings))  # type: ignore[arg-type]
    except ConfigError as told:
        yield refusal(told)
        return
    yield from arm.check_poses()
    found = find_application(cell.application).find("checks", "reach")
    if found is not None:
        yield from _each(lambda: found(cell, arm))


def _of_application(cell: Cell, name: str) -> list[Finding]:
    found = find_application(cell.application).find("checks", name)
    return [] if found is None else _each(lambda: found(cell))


def _each(look: Callable[[], Iterator[Finding]]) -> list[Finding]:
    """What a look finds; an error of the configuration on the way is one more."""
    found: list[Finding] = []
    try:
        found.extend(look())
    except ConfigError as told:
        found.append(refusal(told))
    return found
