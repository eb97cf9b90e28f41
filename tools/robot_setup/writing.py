"""A proposed robot file as text, with what is guessed said beside it."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from common.config import config_root
from common.robot.description import SCHEME, find_description, installed_share
from tools.robot_setup.proposal import Proposal

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
