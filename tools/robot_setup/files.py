"""Files of `zencell robot new`: the robot file as text, and a cell for the robot."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from common.application import find_application
from common.config import config_root, find_file, load_cell, load_robot, read_yaml
from common.errors import ConfigError
from common.robot.mesh_references import SCHEME
from common.robot.model import RobotModel
from common.robot.packages import installed_share
from common.robot.urdf import find_description
from tools.robot_setup.proposal import Proposal

WIDTH = 118
ORDER = ("name", "urdf", "srdf", "package_dirs", "attachments", "visual_as_collision", "allowed_pairs", "joints",
         "base_link", "base_position", "base_rpy", "tcp_link", "tcp", "locked_joints", "named_poses", "position_limits",
         "velocity_limits", "acceleration_limits", "jerk_limits", "gripper")


def robot_file(proposal: Proposal, head: str, folder: Path, srdf: str) -> str:
    """Return the text of a robot file.

    Args:
        proposal: its content.
        head: first lines, a comment.
        folder: of the file; paths of descriptions are relative to it.
        srdf: name of the file next to it with the unchecked pairs.
    """
    values = dict(proposal.values)
    values["urdf"] = reference(values["urdf"], folder)
    values["srdf"] = srdf
    values["package_dirs"] = [_from(folder, Path(each)) for each in values["package_dirs"]]
    values["attachments"] = [each | {"urdf": reference(each["urdf"], folder)} for each in values.get("attachments", [])]
    lines = [*_comment(head)]
    for name in ORDER:
        value = values.get(name)
        if value is None or value in ([], {}, ""):
            continue
        lines += _comment(proposal.notes.get(name, ""))
        lines += _entry(name, value)
    return "\n".join([*lines, "hardware: {backend: mock}   # simulated; docs/robots.md has the real ones", ""])


def reference(urdf: str, folder: Path) -> str:
    """Return the reference to a description in a robot file: package://... if installed, else a relative path.

    The name of a file in config/robots stays a name.
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
    """Return a field in block style, with inner values in one line each."""
    if name in ("named_poses", "gripper"):
        inner = [f"  {_flow(str(key))}: {_flow(each)}" for key, each in value.items()]
        return [f"{name}:", *inner]
    if name in ("position_limits", "attachments", "allowed_pairs"):
        return [f"{name}:", *(f"  - {_flow(each)}" for each in value)]
    return [f"{name}: {_flow(value)}"]


def _flow(value: Any) -> str:
    """Return a value as one line of YAML."""
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
    """Return the function with which a cell's application lays out a world in reach of an arm.

    Raises:
        ConfigError: the application has none.
    """
    application = find_application(load_cell(template).application)
    layout: Layout | None = application.fit_world
    if layout is None:
        raise ConfigError("--like", template, f"is for {application.name}, which lays out no world by reach")
    return layout


def write_cell(path: Path, template: str, robot_path: Path, layout: Layout) -> None:
    """Write a cell like a template, with this robot and a world in its reach."""
    robot = RobotModel.load(load_robot(robot_path))
    tree = layout(robot, read_yaml(find_file("cells", template)))
    tree |= {"cell": path.stem, "robot": os.path.relpath(robot_path.resolve(), path.parent.resolve())}
    head = f"# As {template}, for {robot.config.name}: its world was laid out in reach by `zencell robot new`.\n"
    path.write_text(head + yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=118), encoding="utf-8")
