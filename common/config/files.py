"""Finding and reading the files of the configuration."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import yaml

from common.errors import ConfigError, UnknownName

DEEPEST = 64  # levels of a YAML text, with those that names stand for: no file of a cell has ten
MOST_NODES = 1_000_000  # of one, also where names stand for many of them


def config_root() -> Path:
    """The folder of the configuration: `ZENCELL_CONFIG`, or config/ beside the packages."""
    given = os.environ.get("ZENCELL_CONFIG")
    return Path(given) if given else Path(__file__).resolve().parents[2] / "config"


def names_of(kind: str) -> list[str]:
    """Names that can be given for a kind: cells, robots, worlds or pipelines."""
    return sorted(path.stem for path in (config_root() / kind).glob("*.yaml"))


def parse_yaml(text: str, loader: type = yaml.SafeLoader) -> Any:
    """What a YAML text says.

    Args:
        text: of a person or a file.
        loader: libyaml's is faster, and does not take `{a:}` as the other does.

    Raises:
        yaml.YAMLError: it does not parse, contains itself, is nested deeper than `DEEPEST` or stands for more than
            `MOST_NODES`.
        ValueError: it parses and says what there is not, such as a date.
    """
    try:
        _require_modest(yaml.parse(text, Loader=loader))
        return yaml.load(text, Loader=loader)
    except (ArithmeticError, AttributeError, LookupError):  # PyYAML takes what has a tag for what the tag says
        raise ValueError("a value is not of its kind, or too large") from None


def _require_modest(events: Iterable[yaml.Event]) -> None:
    """Return when the values can be built, which libyaml does by recursion: too deep a text would end the process."""
    named: dict[str, tuple[int, int]] = {}  # nodes and levels that a name stands for, with those of names in it
    within: list[tuple[str | None, int, int]] = []  # name, nodes and levels so far of each collection that we are in

    def refuse(problem: str, event: yaml.Event) -> NoReturn:
        error = yaml.MarkedYAMLError(problem=problem)
        error.problem_mark = event.start_mark  # type: ignore[assignment]  # libyaml's has line and column, too
        raise error

    for event in events:
        if isinstance(event, yaml.CollectionStartEvent):
            within.append((event.anchor, 1, 1))
            if len(within) > DEEPEST:
                refuse(f"nested deeper than {DEEPEST} levels", event)
            continue
        if isinstance(event, yaml.CollectionEndEvent):
            name, size, levels = within.pop()
        elif isinstance(event, yaml.AliasEvent):
            if any(name == event.anchor for name, _, _ in within):
                refuse(f"{event.anchor!r} contains itself", event)
            name, (size, levels) = None, named.get(event.anchor or "", (1, 0))
            if len(within) + levels > DEEPEST:
                refuse(f"nested deeper than {DEEPEST} levels", event)
        elif isinstance(event, yaml.ScalarEvent):
            name, size, levels = event.anchor, 1, 0
        else:
            continue
        if name is not None:
            named[name] = size, levels
        if size > MOST_NODES:
            refuse(f"stands for more than {MOST_NODES} values", event)
        if within:
            above, so_far, deep = within[-1]
            within[-1] = above, so_far + size, max(deep, levels + 1)


def read_yaml(path: Path) -> dict[str, Any]:
    """A mapping from a YAML file.

    Raises:
        ConfigError: the file is not there, does not parse (with line and column), or holds no mapping.
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
    except ValueError as error:  # such as a date that there is not
        raise ConfigError("file", str(path), f"does not parse: {error}") from None
    if not isinstance(loaded, dict):
        raise ConfigError("file", str(path), "must hold a mapping")
    return loaded


def find_file(kind: str, name: str, beside: Path | None = None) -> Path:
    """The file that a name stands for: a path (absolute, or relative to `beside`), or a name of config/<kind>.

    Raises:
        UnknownName: with the choices.
    """
    if name.endswith((".yaml", ".yml")):
        path = (beside or Path()) / Path(name).expanduser()
        if not path.is_file():
            raise ConfigError(kind.removesuffix("s"), str(path), "is not a file")
        return path
    path = config_root() / kind / f"{name}.yaml"
    if not path.is_file():
        raise UnknownName(kind.removesuffix("s"), name, names_of(kind))
    return path


def read_robot(path: Path) -> dict[str, Any]:
    """A robot file, with references to files and folders that lie beside it made absolute.

    Raises:
        ConfigError: as `read_yaml`.
    """
    return made_absolute(read_yaml(path), path.parent)


def read_world(path: Path) -> dict[str, Any]:
    """A world file, with the files that it names: see `with_files`.

    Raises:
        ConfigError: as `read_yaml` and `read_camera`.
    """
    return with_files(read_yaml(path), path.parent)


def with_files(world: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The world, whose files are relative to the folder.

    A camera that is the path of a file of `zencell calibrate` gets the values of that file; paths of meshes are made
    absolute.
    """
    cameras, objects = world.get("cameras"), world.get("objects")
    for table, names in ((world, ["camera"]), (cameras, list(cameras) if isinstance(cameras, dict) else [])):
        for name in names:
            if isinstance(table, dict) and isinstance(table.get(name), str):
                table[name] = read_camera(folder / Path(table[name]).expanduser())
    for thing in objects if isinstance(objects, list) else []:
        if isinstance(thing, dict) and isinstance(thing.get("mesh"), str):
            thing["mesh"] = str((folder / Path(thing["mesh"]).expanduser()).resolve())
    return world


def read_camera(path: Path) -> dict[str, Any]:
    """Intrinsics and pose from a file of `zencell calibrate`, without the record of how they came about.

    Raises:
        ConfigError: as `read_yaml`, or one of them is missing in the file.
    """
    camera = read_yaml(path)
    camera.pop("calibration", None)
    for fields, verb in ((("width", "height", "fx", "fy", "cx", "cy"), "intrinsics"), (("position", "rpy"), "pose")):
        missing = [field for field in fields if field not in camera]
        if missing:
            raise ConfigError("world.camera", str(path), f"has no {missing[0]}: `zencell calibrate {verb}` writes it")
    return {"mount": "", **camera}  # of a camera in whose place it comes, the mount is not meant


def made_absolute(robot: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The robot, whose descriptions and folders of descriptions are absolute where they lie in a folder."""
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
