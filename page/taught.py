"""Joint positions that a person gave a name: a file per cell, in the folder where this user's decisions are kept."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path
from typing import Annotated

import yaml
from pydantic import Field

from common.atomic_file import state_folder
from common.config import Section, check, read_yaml
from common.errors import ConfigError

HEADER = "# Poses that were taught on the page: joint positions [rad, m] by name.\n"
MOST = 200
Value = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=40, pattern=r"^[^\s,][^,\n]*$")]


class Taught(Section):
    """What was taught in a cell."""

    poses: dict[Name, dict[str, Value]] = Field({}, max_length=MOST, description="joints by the name of the pose")

    def named(self, name: str, joints: list[str]) -> list[float]:
        """Positions of the joints in a pose [rad, m].

        Raises:
            ConfigError: there is no such pose, or it is one of other joints.
        """
        pose = self.poses.get(name)
        if pose is None:
            raise ConfigError("pose", name, f"was not taught; choices: {', '.join(self.poses) or 'none'}")
        if set(pose) != set(joints):
            raise ConfigError("pose", name, "was taught with another arm")
        return [pose[joint] for joint in joints]


def taught_file(cell: str) -> Path:
    """Where the poses of a cell are kept."""
    return state_folder() / f"{cell}.poses.yaml"


def load_taught(path: Path) -> Taught:
    """What was taught; nothing where there is no file yet.

    Raises:
        ConfigError: the file does not parse, or holds something else.
    """
    return check(Taught, read_yaml(path), str(path)) if path.is_file() else Taught()


def write_whole(path: Path, text: str) -> None:
    """Write a file, all of it or nothing; its folder is made.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())  # else there may be nothing in it after a power cut
        Path(name).chmod(path.stat().st_mode if path.exists() else 0o644)
        Path(name).replace(path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            Path(name).unlink()
        raise


def save_taught(path: Path, taught: Taught) -> None:
    """Write the file.

    Raises:
        OSError: it cannot be written.
    """
    write_whole(path, HEADER + yaml.safe_dump(taught.model_dump(mode="json"), sort_keys=False, allow_unicode=True))
