"""From files and overrides to a cell, and from a cell to the configuration of a service."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from common.application import application_of_task, find_application, import_from_folder_of
from common.config.basics import Parameters
from common.config.cell import Cell
from common.config.checking import check, is_section
from common.config.files import (
    find_file,
    made_absolute,
    names_of,
    read_camera,
    read_robot,
    read_world,
    read_yaml,
    with_files,
)
from common.config.overrides import expanded, parse_override
from common.config.robot import RobotConfig
from common.config.world import CAMERA, Surroundings
from common.errors import ConfigError, UnknownName
from common.remapping import SERVICE_NAME, validate_table

NOT_A_SERVICE = ("router", "supervisor", "recorder")  # processes beside the services, which have names too
WHOLE = ("robot", "world", "pipeline", "services")  # overrides of all of these come before those of their parts
P = TypeVar("P", bound=Parameters)


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
    """What lies at a path of the tree; None if nothing does."""
    node: Any = tree
    for part in path:
        node = node.get(part) if isinstance(node, dict) else None
    return node


def load_cell(
    cell: str, overrides: Sequence[str] = (), *, world: str | None = None, seed: int | None = None
) -> Cell:
    """Resolve a cell by its name in config/cells or the path of a YAML file.

    Args:
        cell: a name, or a path that ends in .yaml.
        overrides: `PATH=VALUE` each, or `@FILE` for those of a file, applied after all files were read.
        world: name or path of a world that replaces the cell's.
        seed: replaces the cell's seed.

    Raises:
        ConfigError, UnknownName: one line naming the field, the value and the choices.
    """
    path = find_file("cells", cell)
    import_from_folder_of(cell)
    tree = read_yaml(path)
    parsed = [parse_override(text) for text in expanded(overrides)]
    given = {parts[0]: value for parts, value in parsed if len(parts) == 1}  # which file to read may be overridden
    given |= {"world": world} if world is not None else {}
    tree |= {part: given[part] for part in WHOLE if part in given}
    for part in ("robot", "world", "pipeline"):
        value = tree.get(part)
        if isinstance(value, str):
            # A path in the cell is relative to it; one that a person gives, to where the person stands.
            here = part in given and Path(value).expanduser().is_file()
            read = {"robot": read_robot, "world": read_world}.get(part, read_yaml)
            tree[part] = read(find_file(f"{part}s", value, None if here else path.parent))
        elif part == "robot" and isinstance(value, dict):
            tree[part] = made_absolute(value, path.parent)
        elif part == "world" and isinstance(value, dict):
            tree[part] = with_files(value, path.parent)
        elif not isinstance(value, dict):
            raise ConfigError(part, value, f"must be a name or a mapping; choices: {', '.join(names_of(part + 's'))}")
    services = tree.get("services")
    if not isinstance(services, dict):
        raise ConfigError("services", services, "must be a mapping of services in start order")
    by_name = {_name_of(str(key)): key for key in services}
    for parts, value in parsed:
        if parts[0] == "services" and len(parts) > 1 and parts[1] not in services:
            if parts[1] not in by_name:
                raise UnknownName("service", parts[1], by_name)
            parts[1] = by_name[parts[1]]
        if parts[0] == "world":
            _name_one(tree["world"], parts)
        is_camera = parts == ["world", "camera"] or (len(parts) == 3 and parts[:2] == ["world", "cameras"])
        if is_camera and isinstance(value, str):
            before = _at(tree, parts)
            camera = {**(before if isinstance(before, dict) else {}), **read_camera(Path(value).expanduser())}
            _override(tree, parts, camera)
        elif len(parts) > 1 or parts[0] not in WHOLE:
            _override(tree, parts, value)
    if "run" in tree:
        raise ConfigError("run", tree["run"], "is no section of a cell: autostart and seed stand at its top")
    run = {"cell": tree.pop("cell", path.stem), "autostart": tree.pop("autostart", True), "seed": tree.pop("seed", 0)}
    if seed is not None:
        run["seed"] = seed
    tree["run"] = run
    tree["services"] = _service_entries(services)
    _name_application(tree)
    return check(Cell, tree)


def load_robot(robot: str | Path) -> RobotConfig:
    """The robot of a file, by its name in config/robots or its path.

    Raises:
        ConfigError, UnknownName: one line naming the field, the value and the choices.
    """
    return check(RobotConfig, read_robot(find_file("robots", str(robot))), "robot")


def _name_application(tree: dict[str, Any]) -> None:
    """Let an application name the cell's task, or the task, in older files, the application.

    Raises:
        UnknownName, ConfigError: there is no such application.
    """
    task, given = tree.get("task"), tree.get("application")
    kinds = {name: entry["module"].rpartition(".")[2] for name, entry in tree["services"].items()}
    if given is None and isinstance(task, str):
        tree["application"] = application_of_task(kinds.get(task, task))
    elif isinstance(given, str):
        kind = find_application(given).task or given.rpartition(".")[2]
        tree.setdefault("task", next((name for name in kinds if kinds[name] == kind), kind))


def _name_one(world: dict[str, Any], path: list[str]) -> None:
    """Have world and override speak alike of cameras and of containers: of a single one, or of several by name."""
    for one, many in (("camera", "cameras"), ("container", "containers")):
        several = world.get(many)
        if path[1:2] == [many] and several is None:
            single = world.pop(one, None) or {}
            name = CAMERA if one == "camera" else single.get("id", "box")
            world[many] = {name: single} if single or one == "camera" else {}
        elif path[1:2] == [one] and isinstance(several, dict) and len(several) == 1:
            path[1:2] = [many, *several]


def _name_of(key: str) -> str:
    """The name of a service that stands under a key of the cell file: a dotted module goes by its last part."""
    return key.rpartition(".")[2]


def _service_entries(services: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The services by their names, in start order."""
    entries: dict[str, dict[str, Any]] = {}
    for key, given in services.items():
        entry = _service_entry(str(key), given)
        name = entry["name"]
        if name in entries:
            before = entries[name]["module"]
            raise ConfigError(f"services.{key}", ..., f"{before} goes by the name {name} already: give this one a name "
                              f"of its own, as in another_{name}: {{service: {key}}}")
        entries[name] = entry
    return entries


def _service_entry(key: str, given: Any) -> dict[str, Any]:
    if given is not None and not isinstance(given, dict):
        raise ConfigError(f"services.{key}", given, "must be a mapping of parameters")
    parameters = dict(given or {})
    kind = parameters.pop("service", key)
    if not isinstance(kind, str) or not kind:
        raise ConfigError(f"services.{key}.service", kind, f"must be a service; choices: {', '.join(service_names())}")
    name = _name_of(key)
    if not SERVICE_NAME.fullmatch(name) or name in NOT_A_SERVICE:
        raise ConfigError("services", key, "is not a name that a service can have: letters, digits and _, but not "
                          + ", ".join(NOT_A_SERVICE))
    module = kind if "." in kind else f"services.{kind}"
    if "." not in kind and importlib.util.find_spec(module) is None:
        raise UnknownName("service", kind, service_names())
    topics = validate_table(f"services.{name}.topics", parameters.pop("topics", None) or {})
    return {"name": name, "module": module, "topics": topics, "parameters": parameters}


def service_names() -> list[str]:
    """Services that come with the project: the modules in services/."""
    folder = Path(__file__).resolve().parents[2] / "services"
    return sorted(path.stem for path in folder.glob("[a-z]*.py"))


def service_config(cell: Cell, name: str, config: type[P]) -> P:
    """The configuration of one service: its parameters from the cell, and the sections that it declares.

    Raises:
        ConfigError: names `services.<name>.<parameter>`, the value and the bounds or choices.
    """
    entry = cell.services.get(name)
    given = dict(entry.parameters) if entry else {}
    # A parameter for whoever looks through one of several cameras, unless the service has one of that name itself.
    sections = [info.annotation for info in config.model_fields.values() if is_section(info.annotation)]
    chooses = Surroundings in sections and "camera" not in config.model_fields
    camera = given.pop("camera", None) if chooses else None
    if camera is not None and camera not in cell.world.cameras:
        raise ConfigError(f"services.{name}.camera", camera, f"must be one of {', '.join(cell.world.cameras)}")
    for field, info in config.model_fields.items():
        if is_section(info.annotation):
            # A copy: what a service changes in it at run time stays with it.
            given[field] = cell.section(info.annotation, camera).model_copy()  # type: ignore[arg-type]
    return check(config, given, f"services.{name}")
