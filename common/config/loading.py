"""Load a cell from files and overrides, and the configuration of a service from a cell."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic_core import to_jsonable_python

from common.application import application_of_task, applications, find_application, import_from_folder_of
from common.arms import arm_table
from common.config.arms import read_arm, read_robots, require_arm, services_of_arms
from common.config.basics import Parameters, check, is_section, own_fields
from common.config.cell import Cell
from common.config.files import (
    config_root,
    find_file,
    names_of,
    parse_yaml,
    read_camera,
    read_robot,
    read_world,
    read_yaml,
    with_absolute_paths,
    with_files,
)
from common.config.robot import RobotConfig
from common.config.world import CAMERA, Surroundings
from common.errors import ConfigError, UnknownName, ZencellError
from common.remapping import POSE_KEYS, SERVICE_NAME, validate_table

NOT_A_SERVICE = ("router", "supervisor", "recorder")  # names of other processes
# An override of a complete section precedes those of its fields.
SECTIONS = ("robot", "robots", "world", "pipeline", "services")
ARM_TASKS = "arm_tasks"  # the service that combines the tasks of several arms
P = TypeVar("P", bound=Parameters)
OVERRIDES_VARIABLE = "ZENCELL_SET"  # JSON list of overrides that a supervisor gives to its services


def parse_override(text: str, option: str = "--set") -> tuple[list[str], Any]:
    """Return the dotted path and the YAML value of `PATH=VALUE`; errors name the `option`."""
    path, found, value = text.partition("=")
    if not found or not path.strip():
        raise ConfigError(option, text, "must be PATH=VALUE, for example world.count=5, or @FILE.yaml")
    try:
        return path.strip().split("."), parse_yaml(value)
    except (yaml.YAMLError, ValueError):  # an impossible date, for example
        raise ConfigError(f"{option} {path}", value, "is not a YAML value") from None


def expanded(overrides: Sequence[str]) -> list[str]:
    """Return the overrides with `@FILE` replaced by `PATH=VALUE` for every value of the file.

    Raises:
        ConfigError: a file cannot be read, or holds no mapping.
    """
    found = []
    for text in overrides:
        if text.startswith("@"):
            tree = read_yaml(Path(text[1:]).expanduser())
            found += [f"{'.'.join(path)}={yaml_line(value)}" for path, value in _values(tree)]
        else:
            found.append(text)
    return found


def _values(tree: Mapping[Any, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every value of a tree with its path, except empty ones."""
    for key, value in tree.items():
        name = str(key).rpartition(".")[2] if above == ("services",) else str(key)  # as `_name_of`
        if isinstance(value, Mapping):
            yield from _values(value, (*above, name))
        elif value is not None:
            yield (*above, name), value


def yaml_line(value: Any) -> str:
    """Return a value as one line of YAML, for `PATH=VALUE`."""
    plain = to_jsonable_python(value)
    text = _flow(plain)
    # YAML spreads a text with line breaks, of which Unicode has several, over lines unless it is quoted and escaped.
    return text if len(text.splitlines()) <= 1 else _flow(plain, quoted=True)


def _flow(value: Any, *, quoted: bool = False) -> str:
    text: str = yaml.safe_dump(
        value, default_flow_style=True, default_style='"' if quoted else None, allow_unicode=not quoted, width=math.inf,
        sort_keys=False,
    )
    return text.removesuffix("\n").removesuffix("\n...")


def _override(tree: dict[str, Any], path: Sequence[str], value: Any) -> None:
    node = tree
    for depth, part in enumerate(path[:-1]):
        child = node.setdefault(part, {})
        if child is None:
            child = node[part] = {}
        if not isinstance(child, dict):
            raise ConfigError("--set", ".".join(path), f"cannot go below {'.'.join(path[: depth + 1])}, a value")
        node = child
    node[path[-1]] = value


def _at(tree: dict[str, Any], path: Sequence[str]) -> Any:
    """Return the value at a path of the tree, or None."""
    node: Any = tree
    for part in path:
        node = node.get(part) if isinstance(node, dict) else None
    return node


def default_cell() -> str:
    """Return the name of the cell that commands suggest: the first of the default application, with one robot.

    Raises:
        UnknownName: the configuration has no cell.
    """
    names, tried = names_of("cells"), next((found.name for found in applications() if found.default), "")
    if not names:
        raise UnknownName("cell", "", names)
    trees = ((name, read_yaml(config_root() / "cells" / f"{name}.yaml")) for name in names)
    return next((name for name, tree in trees if tree.get("application") == tried and "robot" in tree), names[0])


def load_cell(
    cell: str, overrides: Sequence[str] = (), *, world: str | None = None, seed: int | None = None
) -> Cell:
    """Resolve a cell by its name in config/cells or the path of a YAML file.

    Args:
        cell: a name, or a path that ends in .yaml.
        overrides: `PATH=VALUE` each, or `@FILE` for those of a file, applied after all files are read.
        world: name or path of a world that replaces the cell's.
        seed: replaces the cell's seed.

    Raises:
        ConfigError, UnknownName: one line naming the field, the value and the choices.
    """
    path = find_file("cells", cell)
    import_from_folder_of(cell)
    tree = read_yaml(path)
    parsed = [parse_override(text) for text in expanded(overrides)]
    _read_sections(tree, parsed, world, path.parent)
    services = tree.get("services")
    if not isinstance(services, dict):
        raise ConfigError("services", services, "must be a mapping of services in start order")
    arms = list(tree.get("robots", ()))
    services = tree["services"] = services_of_arms(services, arms)
    _apply_overrides(tree, parsed)
    if arms:
        tree["robots"] = {arm: check(RobotConfig, tree["robots"][arm], f"robots.{arm}") for arm in arms}
        tree["robot"] = tree["robots"][arms[0]]
    if "run" in tree:
        raise ConfigError("run", tree["run"], "is no section of a cell: autostart and seed are top-level fields")
    run = {"cell": tree.pop("cell", path.stem), "autostart": tree.pop("autostart", True), "seed": tree.pop("seed", 0)}
    if seed is not None:
        run["seed"] = seed
    tree["run"] = run
    tree["services"] = _service_entries(services, arms)
    _name_application(tree)
    if arms:
        _remap_arms(tree["services"], arms[0], tree.get("application", ""))
    return check(Cell, tree)


def _read_sections(
    tree: dict[str, Any], overrides: Iterable[tuple[list[str], Any]], world: str | None, folder: Path
) -> None:
    """Replace complete sections as overridden, and the names of robot, world and pipeline by what their files hold.

    A path in the cell file is relative to its `folder`; one of an override to the working directory.
    """
    overridden = {parts[0]: value for parts, value in overrides if len(parts) == 1}
    overridden |= {"world": world} if world is not None else {}
    read_robots(tree, overridden, folder)
    tree |= {section: overridden[section] for section in SECTIONS if section in overridden and section != "robots"}
    for section in ("world", "pipeline") if "robots" in tree else ("robot", "world", "pipeline"):
        value = tree.get(section)
        if isinstance(value, str):
            in_cwd = section in overridden and Path(value).expanduser().is_file()
            read = {"robot": read_robot, "world": read_world}.get(section, read_yaml)
            tree[section] = read(find_file(f"{section}s", value, None if in_cwd else folder))
        elif section == "robot" and isinstance(value, dict):
            tree[section] = with_absolute_paths(value, folder)
        elif section == "world" and isinstance(value, dict):
            tree[section] = with_files(value, folder)
        elif not isinstance(value, dict):
            choices = ", ".join(names_of(f"{section}s"))
            raise ConfigError(section, value, f"must be a name or a mapping; choices: {choices}")


def _apply_overrides(tree: dict[str, Any], overrides: Iterable[tuple[list[str], Any]]) -> None:
    """Set the values of all overrides, except of complete sections; services may be named without their module.

    Raises:
        UnknownName, ConfigError: there is no such service, or the path leads below a value.
    """
    services: dict[str, Any] = tree["services"]
    by_name = {_name_of(str(key)): key for key in services}
    for parts, value in _for_each_arm(overrides, services, list(tree.get("robots", ()))):
        if parts[0] == "services" and len(parts) > 1 and parts[1] not in services:
            adds = len(parts) == 2 and isinstance(value, dict)  # a complete entry is a further service, started last
            if parts[1] not in by_name and not adds:
                raise UnknownName("service", parts[1], by_name)
            parts[1] = by_name.get(parts[1], parts[1])
        if parts[0] == "world":
            _unify_names(tree["world"], parts)
        is_camera = parts == ["world", "camera"] or (len(parts) == 3 and parts[:2] == ["world", "cameras"])
        if is_camera and isinstance(value, str):
            before = _at(tree, parts)
            camera = {**(before if isinstance(before, dict) else {}), **read_camera(Path(value).expanduser())}
            _override(tree, parts, camera)
        elif parts[0] == "robots" and len(parts) > 1:
            if parts[1] not in (arms := tree.get("robots", {})):
                raise UnknownName("arm", parts[1], arms)
            _override(tree, parts, read_arm(parts[1], value, None) if len(parts) == 2 else value)
        elif len(parts) > 1 or parts[0] not in SECTIONS:
            _override(tree, parts, value)


def _for_each_arm(
    overrides: Iterable[tuple[list[str], Any]], services: Mapping[str, Any], arms: Sequence[str]
) -> Iterator[tuple[list[str], Any]]:
    """Yield overrides; one of a service that is listed once for each arm is one for each of them."""
    for parts, value in overrides:
        each = [f"{arm}_{parts[1]}" for arm in arms] if parts[0] == "services" and len(parts) > 2 else []
        if each and parts[1] not in services and all(name in services for name in each):
            if len(parts) > 3 and parts[2] in arms:  # as in the cell file, a parameter of one arm
                yield [parts[0], f"{parts[2]}_{parts[1]}", *parts[3:]], value
            else:
                yield from (([parts[0], name, *parts[2:]], value) for name in each)
        else:
            yield parts, value


def load_robot(robot: str | Path) -> RobotConfig:
    """Return the robot of a file, by its name in config/robots or its path.

    Raises:
        ConfigError, UnknownName: one line naming the field, the value and the choices.
    """
    return check(RobotConfig, read_robot(find_file("robots", str(robot))), "robot")


def _name_application(tree: dict[str, Any]) -> None:
    """Set the task from the application or, in older files, the application from the task.

    Raises:
        UnknownName, ConfigError: the application does not exist.
    """
    for name in ("task", "application"):
        if tree.get(name, "") is None:  # `task:` without a value
            del tree[name]
    task, application = tree.get("task"), tree.get("application")
    kinds = {name: entry["module"].rpartition(".")[2] for name, entry in tree["services"].items()}
    if application is None and isinstance(task, str):
        tree["application"] = application_of_task(kinds.get(task, task))
    elif isinstance(application, str):
        kind = find_application(application).task or application.rpartition(".")[2]
        several = next((name for name in kinds if kinds[name] == ARM_TASKS), None) if "robots" in tree else None
        tree.setdefault("task", several or next((name for name in kinds if kinds[name] == kind), kind))


def _unify_names(world: dict[str, Any], path: list[str]) -> None:
    """Make world and override use the same form for cameras and containers: a single one, or several by name."""
    for one, many in (("camera", "cameras"), ("container", "containers")):
        several = world.get(many)
        if path[1:2] == [many] and several is None:
            single = world.pop(one, None) or {}
            name = CAMERA if one == "camera" else single.get("id", "box")
            world[many] = {name: single} if single or one == "camera" else {}
        elif path[1:2] == [one] and isinstance(several, dict) and len(several) == 1:
            path[1:2] = [many, *several]


def _name_of(key: str) -> str:
    """Return the name of a service from its key in the cell file: the last part of a dotted module."""
    return key.rpartition(".")[2]


def _service_entries(services: dict[str, Any], arms: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the services by name, in start order."""
    entries: dict[str, dict[str, Any]] = {}
    for key, parameters in services.items():
        entry = _service_entry(str(key), parameters, arms)
        name = entry["name"]
        if name in entries:
            before = entries[name]["module"]
            raise ConfigError(f"services.{key}", ..., f"{before} has the name {name} already: give this one another "
                              f"name, as in another_{name}: {{service: {key}}}")
        entries[name] = entry
    return entries


def _service_entry(key: str, values: Any, arms: Sequence[str]) -> dict[str, Any]:
    if values is not None and not isinstance(values, dict):
        raise ConfigError(f"services.{key}", values, "must be a mapping of parameters")
    parameters = dict(values or {})
    kind = parameters.pop("service", key)
    if not isinstance(kind, str) or not kind:
        raise ConfigError(f"services.{key}.service", kind, f"must be a service; choices: {', '.join(service_names())}")
    name = _name_of(key)
    if not SERVICE_NAME.fullmatch(name) or name in NOT_A_SERVICE:
        raise ConfigError("services", key, "is not a valid service name: letters, digits and _, but not "
                          + ", ".join(NOT_A_SERVICE))
    module = kind if "." in kind else f"services.{kind}"
    if "." not in kind and importlib.util.find_spec(module) is None:
        raise UnknownName("service", kind, service_names())
    topics = validate_table(f"services.{name}.topics", parameters.pop("topics", None) or {})
    arm = parameters.pop("arm", "") if arms else ""
    return {"name": name, "module": module, "arm": arm, "topics": topics, "parameters": parameters}


def _remap_arms(services: Mapping[str, dict[str, Any]], first: str, application: str) -> None:
    """Put the keys of an arm below its name for its services; the tables of the cell file go first.

    Services of all arms read the poses of cameras, and of one on a hand, from the first arm.
    """
    more = find_application(application).arm_keys
    for entry in services.values():
        own = arm_table(entry["arm"], more) if entry["arm"] else {key: f"{first}/{key}" for key in POSE_KEYS}
        entry["topics"] = own | entry["topics"]


def service_names() -> list[str]:
    """Return the services of the project: the modules in services/."""
    folder = Path(__file__).resolve().parents[2] / "services"
    return sorted(path.stem for path in folder.glob("[a-z]*.py"))


def service_config(cell: Cell, name: str, config: type[P]) -> P:
    """Return the configuration of one service: its parameters from the cell, and the sections that it declares.

    Raises:
        ConfigError: names `services.<name>.<parameter>`, the value and the bounds or choices.
    """
    entry = cell.services.get(name)
    values, arm = (dict(entry.parameters), entry.arm) if entry else ({}, "")
    # `camera` selects the camera of the surroundings, unless the service declares a parameter of that name.
    sections = [info.annotation for info in config.model_fields.values() if is_section(info.annotation)]
    if entry and cell.robots and not arm and RobotConfig in sections and not config.ALL_ARMS:
        require_arm(name, entry.kind, list(cell.robots))
    selects_camera = Surroundings in sections and "camera" not in config.model_fields
    camera = values.pop("camera", None) if selects_camera else None
    if camera is not None and camera not in cell.world.cameras:
        raise ConfigError(f"services.{name}.camera", camera, f"must be one of {', '.join(cell.world.cameras)}")
    for field, info in config.model_fields.items():
        if is_section(info.annotation):
            if field in values:  # it would be replaced by the cell's
                raise ConfigError(f"services.{name}.{field}", values[field], "is a section of the cell, no parameter "
                                  f"of a service; choices: {', '.join(own_fields(config))}")
            # A copy, because each service changes its parameters at run time.
            values[field] = cell.section(info.annotation, camera, arm).model_copy()  # type: ignore[arg-type]
    return check(config, values, f"services.{name}")


def located(error: ZencellError, config: Parameters, service: str) -> ZencellError:
    """Return an error that a service raised in use, with the complete path if it names a parameter of the service."""
    if isinstance(error, ConfigError) and error.field.partition(".")[0] in own_fields(type(config)):
        return error.within(f"services.{service}")
    return error
