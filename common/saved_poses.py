"""Saved poses: named joint positions in a file per cell, in the folder of this user's state."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import yaml
from pydantic import Field

from common.atomic_file import state_folder, write_atomically
from common.config import Section, check, read_yaml
from common.errors import ConfigError

HEADER = "# Poses that were saved on the page: joint positions [rad, m] by name.\n"
MAX_POSES = 200
Value = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=40, pattern=r"^[^\s,][^,\n]*$")]
Poses = dict[str, dict[str, float]]


class SavedPoses(Section):
    """The saved poses of a cell."""

    poses: dict[Name, dict[str, Value]] = Field({}, max_length=MAX_POSES, description="joint positions by pose")

    def named(self, name: str, joints: list[str]) -> list[float]:
        """Return the joint positions of a pose [rad, m].

        Raises:
            ConfigError: no pose has that name, or it belongs to a robot with other joints.
        """
        pose = self.poses.get(name)
        if pose is None:
            raise ConfigError("pose", name, f"is not saved; choices: {', '.join(self.poses) or 'none'}")
        if set(pose) != set(joints):
            raise ConfigError("pose", name, "was saved for a robot with other joints")
        return [pose[joint] for joint in joints]


def poses_file(cell: str) -> Path:
    """Return the path of the saved poses of a cell."""
    return state_folder() / f"{cell}.poses.yaml"


def load_poses(path: Path) -> SavedPoses:
    """Return the saved poses; none if there is no file yet.

    Raises:
        ConfigError: the file does not parse, or has another content.
    """
    return check(SavedPoses, read_yaml(path), str(path)) if path.is_file() else SavedPoses()


def save_poses(path: Path, poses: SavedPoses) -> None:
    """Write the file.

    Raises:
        OSError: it cannot be written.
    """
    body = yaml.safe_dump(poses.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    write_atomically(path, HEADER + body)
