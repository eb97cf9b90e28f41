"""A URDF made of a xacro file, where the tool for that is installed."""

from __future__ import annotations

import importlib
import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from common.application import find_application
from common.config import config_root, find_file, load_cell, load_robot, read_yaml
from common.errors import ConfigError
from common.robot.model import RobotModel
from common.robot.urdf import SCHEME, find_description, installed_share, package_folders, read_urdf
from tools.robot_setup.proposal import Proposal


def urdf_of_xacro(reference: str, folder: Path, *, overwrite: bool) -> str:
    """Path of the URDF that was made of a xacro file and written to a folder.

    Raises:
        ConfigError: the tool is not installed, or does not read the file, or a URDF of that name is there already.
    """
    path = find_description("urdf", reference)
    try:
        xacro = importlib.import_module("xacro")
    except ImportError:
        raise ConfigError("urdf", reference, "is a xacro file: pip install xacro, which makes a URDF of it") from None
    try:
        text = xacro.process_file(str(path)).toxml()
    except Exception as error:  # whatever the tool makes of it
        said = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError("urdf", reference, f"is no xacro file that can be read: {said}") from None
    name = path.name.removesuffix(".xacro").removesuffix(".urdf")
    made = folder / f"{name}.urdf"
    if made.exists() and not overwrite:
        raise ConfigError("urdf", reference, f"becomes {made}, which is there already; --force overwrites it")
    made.write_text(text, encoding="utf-8")
    return str(made)


def folders_of_meshes(field: str, urdf: str, configured: Sequence[str], source: str = "") -> list[str]:
    """Folders above a URDF, or above the file that it was made of, that hold packages which are not found otherwise.

    Raises:
        ConfigError: a mesh is nowhere.
    """
    root = read_urdf(field, urdf, configured)
    above = find_description(field, source or urdf, configured).parents
    found: list[str] = []
    missing: list[str] = []
    for name in dict.fromkeys(mesh.get("filename", "") for mesh in root.iter("mesh")):
        inside = name.removeprefix(SCHEME)
        if not name.startswith(SCHEME):
            path = Path(name.removeprefix("file://"))
            missing += [] if path.is_file() else [name]
        elif not any((folder / inside).is_file() for folder in package_folders([*configured, *found])):
            holder = next((folder for folder in above if (folder / inside).is_file()), None)
            if holder is None:
                missing.append(name)
            else:
                found.append(str(holder))
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ConfigError(field, urdf, f"has meshes that are not there: {missing[0]}{more}; --package-dir DIR names "
                                       "the folder that holds their package")
    return found


WIDTH = 118
ORDER = ("name", "urdf", "srdf", "package_dirs", "attachments", "joints", "base_link", "tcp_link", "tcp",
         "locked_joints", "named_poses", "position_limits", "velocity_limits", "acceleration_limits", "jerk_limits",
         "gripper")


def robot_file(made: Proposal, head: str, folder: Path, srdf: str) -> str:
    """The text of the file.

    Args:
        made: what stands in it.
        head: first lines, a comment.
        folder: where it will lie: descriptions that are no packages are named from there.
        srdf: name of the file beside it with the pairs that are not checked.
    """
    values = dict(made.values)
    values["urdf"] = reference(values["urdf"], folder)
    values["srdf"] = srdf
    values["package_dirs"] = [_from(folder, Path(each)) for each in values["package_dirs"]]
    values["attachments"] = [each | {"urdf": reference(each["urdf"], folder)} for each in values.get("attachments", [])]
    lines = [*_comment(head)]
    for name in ORDER:
        value = values.get(name)
        if value is None or value in ([], {}, ""):
            continue
        lines += _comment(made.notes.get(name, ""))
        lines += _entry(name, value)
    return "\n".join([*lines, "hardware: {backend: mock}   # simulated; docs/robots.md has the real ones", ""])


def reference(urdf: str, folder: Path) -> str:
    """What a robot file in a folder calls a description: package://... where it is installed, else a path.

    One of config/robots that was given by its name stays a name.
    """
    by_name = not Path(urdf).expanduser().is_file() and (config_root() / "robots" / urdf).is_file()
    if urdf.startswith(SCHEME) or by_name:
        return urdf
    path, share = find_description("urdf", urdf), installed_share()
    if share is not None and path.is_relative_to(share):
        return SCHEME + path.relative_to(share).as_posix()
    return _from(folder, path)


def _from(folder: Path, path: Path) -> str:
    return Path(os.path.relpath(path.expanduser().resolve(), folder.resolve())).as_posix()


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent="# ", subsequent_indent="# ", break_long_words=False)


def _entry(name: str, value: Any) -> list[str]:
    """A field in block style, whose innermost values stand in one line."""
    if name in ("named_poses", "gripper"):
        inner = [f"  {key}: {_flow(each)}" for key, each in value.items()]
        return [f"{name}:", *inner]
    if name in ("position_limits", "attachments"):
        return [f"{name}:", *(f"  - {_flow(each)}" for each in value)]
    return [f"{name}: {_flow(value)}"]


def _flow(value: Any) -> str:
    """In one line of YAML."""
    text = yaml.safe_dump(_plain(value), default_flow_style=True, width=10**6, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...").strip()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value]
    return round(float(value), 6) if isinstance(value, float) else value


Layout = Callable[[RobotModel, dict[str, Any]], dict[str, Any]]


def world_layout(template: str) -> Layout:
    """What lays out a world in reach of an arm, for the application of a cell.

    Raises:
        ConfigError: it lays out none by reach.
    """
    application = find_application(load_cell(template).application)
    layout: Layout | None = application.fit_world
    if layout is None:
        raise ConfigError("--like", template, f"is for {application.name}, which lays out no world by reach")
    return layout


def write_cell(path: Path, template: str, robot_path: Path, layout: Layout) -> None:
    """Write a cell like another, with this robot and a world in its reach."""
    robot = RobotModel.load(load_robot(robot_path))
    tree = layout(robot, read_yaml(find_file("cells", template)))
    tree |= {"cell": path.stem, "robot": os.path.relpath(robot_path.resolve(), path.parent.resolve())}
    head = f"# As {template}, for {robot.config.name}: its world was laid out in reach by `zencell robot new`.\n"
    path.write_text(head + yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=118), encoding="utf-8")
