"""Find and read the files of the configuration."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import yaml

from common.errors import ConfigError, UnknownName

MAX_LEVELS = 64  # of nesting in a YAML text, aliases expanded: no cell file has ten
MAX_NODES = 1_000_000  # of a YAML text, aliases expanded


def config_root() -> Path:
    """Return the folder of the configuration: `ZENCELL_CONFIG`, else config/ next to the packages."""
    given = os.environ.get("ZENCELL_CONFIG")
    return Path(given) if given else Path(__file__).resolve().parents[2] / "config"


def names_of(kind: str) -> list[str]:
    """Return the names of a kind of files: cells, robots, worlds or pipelines."""
    return sorted(path.stem for path in (config_root() / kind).glob("*.yaml"))


def read_file(path: Path, field: str, most: int) -> bytes:
    """Return the content of a file that a configuration names.

    Args:
        path: of the file.
        field: of the configuration that names it.
        most: limit of its size [bytes].

    Raises:
        ConfigError: it cannot be read, or is larger.
    """
    try:
        if (size := path.stat().st_size) > most:
            raise ConfigError(field, str(path), f"has {size} bytes; the limit is {most}")
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(field, str(path), f"cannot be read: {error.strerror}") from None


def parse_yaml(text: str, loader: type = yaml.SafeLoader) -> Any:
    """Return the value of a YAML text.

    Args:
        text: from a user or a file.
        loader: libyaml's is faster, and refuses `{a:}`.

    Raises:
        yaml.YAMLError: it does not parse, contains itself, is nested deeper than `MAX_LEVELS` or expands to more than
            `MAX_NODES`.
        ValueError: it parses but has an impossible value, such as a date.
    """
    try:
        _require_bounded(yaml.parse(text, Loader=loader))
        return yaml.load(text, Loader=loader)
    except (ArithmeticError, AttributeError, LookupError):  # PyYAML trusts tags
        raise ValueError("a value does not fit its tag, or is too large") from None


def _require_bounded(events: Iterable[yaml.Event]) -> None:
    """Return if the text is within the limits: libyaml builds values by recursion, and a deep text would crash."""
    named: dict[str, tuple[int, int]] = {}  # nodes and levels of each anchor, aliases expanded
    within: list[tuple[str | None, int, int]] = []  # anchor, nodes and levels so far of each open collection
    keys: list[set[str] | None] = []  # keys so far of each open mapping; None: of a list
    is_key: list[bool] = []  # for each of them, whether a key comes next

    def refuse(problem: str, event: yaml.Event) -> NoReturn:
        error = yaml.MarkedYAMLError(problem=problem)
        error.problem_mark = event.start_mark  # type: ignore[assignment]  # libyaml's mark has line and column, too
        raise error

    for event in events:
        if isinstance(event, yaml.CollectionStartEvent):
            within.append((event.anchor, 1, 1))
            keys.append(set() if isinstance(event, yaml.MappingStartEvent) else None)
            is_key.append(True)
            if len(within) > MAX_LEVELS:
                refuse(f"nested deeper than {MAX_LEVELS} levels", event)
            continue
        if isinstance(event, yaml.CollectionEndEvent):
            name, size, levels = within.pop()
            keys.pop()
            is_key.pop()
        elif isinstance(event, yaml.AliasEvent):
            if any(name == event.anchor for name, _, _ in within):
                refuse(f"{event.anchor!r} contains itself", event)
            name, (size, levels) = None, named.get(event.anchor or "", (1, 0))
            if len(within) + levels > MAX_LEVELS:
                refuse(f"nested deeper than {MAX_LEVELS} levels", event)
        elif isinstance(event, yaml.ScalarEvent):
            name, size, levels = event.anchor, 1, 0
            if keys and (known := keys[-1]) is not None and is_key[-1]:
                if event.value in known:  # the parser would ignore the first one
                    refuse(f"{event.value!r} is given twice", event)
                known.add(event.value)
        else:
            continue
        if name is not None:
            named[name] = size, levels
        if size > MAX_NODES:
            refuse(f"expands to more than {MAX_NODES} values", event)
        if within:
            is_key[-1] = not is_key[-1]
            above, so_far, deep = within[-1]
            within[-1] = above, so_far + size, max(deep, levels + 1)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Raises:
        ConfigError: the file is missing, does not parse (with line and column), or holds no mapping.
    """
    try:
        loaded = parse_yaml(path.read_text(encoding="utf-8"), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError("file", str(path), f"cannot be read: {error}") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not valid YAML"
        raise ConfigError("file", str(path), f"does not parse{where}: {problem}") from None
    except ValueError as error:  # an impossible date, for example
        raise ConfigError("file", str(path), f"does not parse: {error}") from None
    if not isinstance(loaded, dict):
        raise ConfigError("file", str(path), "must hold a mapping")
    return loaded


def find_file(kind: str, name: str, folder: Path | None = None) -> Path:
    """Return the file of a name: a path (absolute, or relative to `folder`), or a name in config/<kind>.

    Raises:
        UnknownName: lists the choices.
    """
    if name.endswith((".yaml", ".yml")):
        path = (folder or Path()) / Path(name).expanduser()
        if not path.is_file():
            raise ConfigError(kind.removesuffix("s"), str(path), "is not a file")
        return path
    path = config_root() / kind / f"{name}.yaml"
    if not path.is_file():
        raise UnknownName(kind.removesuffix("s"), name, names_of(kind))
    return path


def read_robot(path: Path) -> dict[str, Any]:
    """Return a robot file with absolute paths of files and folders next to it.

    Raises:
        ConfigError: as `read_yaml`.
    """
    return with_absolute_paths(read_yaml(path), path.parent)


def read_world(path: Path) -> dict[str, Any]:
    """Return a world file with the files that it refers to, as in `with_files`.

    Raises:
        ConfigError: as `read_yaml` and `read_camera`.
    """
    return with_files(read_yaml(path), path.parent)


def with_files(world: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the world with its files read relative to the folder.

    A camera that is the path of a file of `zencell calibrate` gets the values of that file; paths of meshes become
    absolute.
    """
    cameras, objects = world.get("cameras"), world.get("objects")
    for table, names in ((world, ["camera"]), (cameras, list(cameras) if isinstance(cameras, dict) else [])):
        for name in names:
            if isinstance(table, dict) and isinstance(table.get(name), str):
                table[name] = read_camera(folder / Path(table[name]).expanduser())
    for each in objects if isinstance(objects, list) else []:
        if isinstance(each, dict) and isinstance(each.get("mesh"), str):
            each["mesh"] = str((folder / Path(each["mesh"]).expanduser()).resolve())
    return world


def read_camera(path: Path) -> dict[str, Any]:
    """Return intrinsics and pose from a file of `zencell calibrate`, without the record of the calibration.

    Raises:
        ConfigError: as `read_yaml`, or one of them is missing in the file.
    """
    camera = read_yaml(path)
    camera.pop("calibration", None)
    for fields, verb in ((("width", "height", "fx", "fy", "cx", "cy"), "intrinsics"), (("position", "rpy"), "pose")):
        missing = [field for field in fields if field not in camera]
        if missing:
            raise ConfigError("world.camera", str(path), f"has no {missing[0]}: `zencell calibrate {verb}` writes it")
    return {"mount": "", **camera}  # the mount of the camera it replaces does not apply


def with_absolute_paths(robot: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the robot with absolute paths of descriptions and package folders that exist in the folder."""
    attachments = robot.get("attachments")
    for part in [robot, *(attachments if isinstance(attachments, list) else [])]:
        for field in ("urdf", "srdf"):
            reference = part.get(field) if isinstance(part, dict) else None
            if isinstance(reference, str) and "://" not in reference and (folder / reference).is_file():
                part[field] = str((folder / reference).resolve())
    packages = robot.get("package_dirs")
    if isinstance(packages, list):
        robot["package_dirs"] = [
            str((folder / name).resolve()) if isinstance(name, str) and (folder / name).is_dir() else name
            for name in packages
        ]
    return robot
