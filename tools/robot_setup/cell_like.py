"""A cell like another one for a robot of one's own, with a world that lies in its reach."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from common.application import find_application
from common.config import find_file, load_cell, load_robot, read_yaml
from common.errors import ConfigError
from common.robot.model import RobotModel

Layout = Callable[[RobotModel, dict[str, Any]], dict[str, Any]]


def layout_of(template: str) -> Layout:
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
