"""Where the robot's description files lie: paths, and package:// in configured folders or installed packages."""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Sequence
from pathlib import Path

from common.config import config_root
from common.errors import ConfigError

SCHEME = "package://"


@functools.cache
def installed_share() -> Path | None:
    """The share/ folder into which description packages from PyPI (cmeel wheels) install, found beside pinocchio."""
    spec = importlib.util.find_spec("pinocchio")
    if spec is None or spec.origin is None:
        return None
    for parent in Path(spec.origin).resolve().parents:
        if parent.name == "cmeel.prefix":
            return parent / "share"
    return None


def package_folders(configured: Sequence[str]) -> list[Path]:
    """Folders in which package:// is looked up, in order."""
    folders = [Path(folder).expanduser() for folder in configured]
    share = installed_share()
    return [*folders, share] if share else folders


def find_description(field: str, reference: str, configured: Sequence[str] = ()) -> Path:
    """The file that a path or a package:// reference stands for.

    Args:
        field: name of the value in the configuration, for the error.
        reference: package://<package>/..., an absolute path, or one relative to the working or config/robots folder.
        configured: folders that are searched before the installed packages.

    Raises:
        ConfigError: names the file, where it was looked for and what to install.
    """
    if reference.startswith(SCHEME):
        inside = reference.removeprefix(SCHEME)
        folders = package_folders(configured)
        wanted = f"install its package (pip install {inside.partition('/')[0]}) or set robot.package_dirs"
    else:
        inside = str(Path(reference).expanduser())
        folders = [Path(), config_root() / "robots"]
        wanted = "give a path that exists or package://<package>/<file>"
    for folder in folders:
        path = folder / inside
        if path.is_file():
            return path.resolve()
    searched = ", ".join(str(folder) for folder in folders) or "nowhere"
    raise ConfigError(field, reference, f"is not there (looked in {searched}); {wanted}")
