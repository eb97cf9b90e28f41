"""Cell files with several robots: read `robots`, check them, and list the services of each arm."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

from common.config.files import find_file, names_of, read_robot, with_absolute_paths
from common.config.robot import RobotConfig
from common.errors import ConfigError
from common.remapping import PER_SERVICE_KEYS, SERVICE_NAME

BASE_DISTANCE = 0.15  # [m] between the axes of two bases: closer ones overlap for every arm
EACH = "arm"  # the only thing of which a service can be listed once for each


def read_robots(tree: dict[str, Any], overridden: Mapping[str, Any], folder: Path) -> None:
    """Replace the robots of a cell file by what their files hold, and let `robot` be the first of them.

    Args:
        tree: of the cell; unchanged if it has one robot.
        overridden: complete sections that an option sets.
        folder: of the cell file.

    Raises:
        ConfigError, UnknownName: one line naming the field, the value and the choices.
    """
    robots = overridden.get("robots", tree.get("robots"))
    if robots is None and "robots" not in tree:
        return
    if "robot" in tree or "robot" in overridden:
        raise ConfigError("robot", ..., "and robots are given: name one robot, or several below robots")
    if not isinstance(robots, dict) or not robots:
        raise ConfigError("robots", robots, "must be a mapping of arms, as in {left: NAME, right: {robot: NAME, "
                          "base_position: [1.0, 0, 0]}}")
    tree["robots"] = {_arm_name(name): read_arm(str(name), value, folder) for name, value in robots.items()}
    tree["robot"] = next(iter(tree["robots"].values()))


def _arm_name(name: Any) -> str:
    from common.application import all_topics

    taken = {key.partition("/")[0] for key in all_topics()} | {*PER_SERVICE_KEYS, "supervisor"}
    if not isinstance(name, str) or not SERVICE_NAME.fullmatch(name):
        raise ConfigError("robots", name, "is no name of an arm, the first part of its keys: use letters, digits and _")
    if name in taken:
        raise ConfigError("robots", name, "is the first part of other keys already: give the arm another name, such as "
                          "left")
    return name


def read_arm(name: str, value: Any, folder: Path | None) -> dict[str, Any]:
    """Return the robot of an arm, by its name, or by a mapping that may change some of its values.

    Args:
        name: of the arm.
        value: as in the cell file.
        folder: paths are relative to it; None: to the working directory.

    Raises:
        ConfigError, UnknownName: one line naming the field, the value and the choices.
    """
    field = f"robots.{name}"
    if isinstance(value, str):
        return read_robot(find_file("robots", value, folder))
    if not isinstance(value, dict):
        raise ConfigError(field, value, f"must be a name or a mapping; choices: {', '.join(names_of('robots'))}")
    values = dict(value)
    base = values.pop("robot", None)
    if base is not None and not isinstance(base, str):
        raise ConfigError(f"{field}.robot", base, f"must be a name; choices: {', '.join(names_of('robots'))}")
    own = with_absolute_paths(values, folder or Path.cwd())
    return {**read_robot(find_file("robots", base, folder)), **own} if base is not None else own


def require_distinct(robots: Mapping[str, RobotConfig]) -> None:
    """Check that no two arms stand at one place.

    Raises:
        ConfigError: names both arms.
    """
    for (one, first), (other, second) in combinations(robots.items(), 2):
        apart = math.dist(first.base_position, second.base_position)
        if apart < BASE_DISTANCE:
            raise ConfigError(f"robots.{other}.base_position", list(second.base_position), f"is {apart:.3f} m from the "
                              f"base of {one}: their bases overlap, keep at least {BASE_DISTANCE:g} m between them")


def services_of_arms(services: Mapping[str, Any], arms: list[str]) -> dict[str, Any]:
    """Return the services with one entry for each arm of those that are listed once for `each: arm`.

    Such an entry has the name of the arm in front, `left_motion_planner`. A mapping below the name of an arm holds
    parameters of that arm alone. Unchanged in a cell with one robot, whose services may have such parameters.

    Raises:
        ConfigError: an arm does not exist, or `each` is not `arm`.
    """
    if not arms:
        return dict(services)
    found: dict[str, Any] = {}
    for key, values in services.items():
        for name, entry in _entries(str(key), values, arms):
            if name in found:
                raise ConfigError(f"services.{name}", ..., "is listed twice: once by itself and once by `each: arm`")
            found[name] = entry
    return found


def _entries(key: str, values: Any, arms: list[str]) -> Iterator[tuple[str, Any]]:
    if not isinstance(values, dict) or not {"each", "arm"} & set(values):
        yield key, values
        return
    choices = f"choices: {', '.join(arms)}"
    if "each" in values:
        if values["each"] != EACH:
            raise ConfigError(f"services.{key}.each", values["each"], f"must be {EACH}")
        if "arm" in values:
            raise ConfigError(f"services.{key}", ..., "has each and arm: give one of them")
        shared = {name: value for name, value in values.items() if name not in ("each", *arms)}
        kind = key.rpartition(".")[2]
        for arm in arms:
            own = values.get(arm) or {}
            if not isinstance(own, dict):
                raise ConfigError(f"services.{key}.{arm}", own, "must be a mapping: parameters of this arm alone")
            yield f"{arm}_{kind}", {"service": key, **shared, **own, "arm": arm}
        return
    if values["arm"] not in arms:
        raise ConfigError(f"services.{key}.arm", values["arm"], f"is no arm of this cell; {choices}")
    yield key, values


def require_arm(service: str, module: str, arms: list[str]) -> None:
    """Refuse a service of one robot that does not say of which, in a cell with several.

    Raises:
        ConfigError: always, with the remedies.
    """
    raise ConfigError(f"services.{service}", ..., f"{module} needs one robot, and the cell has {', '.join(arms)}: add "
                      f"`each: arm` for one of each, or `arm: {arms[0]}`")

