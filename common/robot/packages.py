"""Folders of description packages, by the name in their package.xml: given, installed, and those around a file."""

from __future__ import annotations

import functools
import importlib.util
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

MANIFEST = "package.xml"
_NAME = re.compile(rb"<name>\s*([^<>\s]+)\s*</name>")
_DEPTH = 5  # levels below a folder: workspace/install/package/share/package
_MAX_FOLDERS = 20_000  # visited below one folder
_SKIPPED = {"build", "log", "node_modules", "__pycache__"}


@functools.cache
def installed_share() -> Path | None:
    """Return the share/ folder of description packages from PyPI (cmeel wheels), next to pinocchio; None if missing."""
    spec = importlib.util.find_spec("pinocchio")
    if spec is None or spec.origin is None:
        return None
    for parent in Path(spec.origin).resolve().parents:
        if parent.name == "cmeel.prefix":
            return parent / "share"
    return None


def package_folders(configured: Sequence[str]) -> list[Path]:
    """Return the folders that are searched for package://, in order: configured, of a sourced ROS, from PyPI."""
    prefixes = [Path(each) / "share" for each in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if each]
    share = installed_share()
    return [*(Path(folder).expanduser() for folder in configured), *prefixes, *([share] if share else [])]


def package_paths(name: str, configured: Sequence[str], near: Path | None = None) -> Iterator[Path]:
    """Yield the folders of a package, likeliest first.

    Args:
        name: of the package; folders may have another, and are then found by their package.xml.
        configured: folders with packages, or a few levels above them.
        near: a file; its package and folders next to those above it come before installed packages.
    """
    if name in ("", ".", "..") or "/" in name:
        return
    given = [Path(each).expanduser() for each in configured]
    above = [folder for folder in near.resolve().parents if len(folder.parts) > 2] if near is not None else []
    yield from (folder for folder in above if package_name(folder) == name)
    yield from (folder / name for folder in [*given, *above] if (folder / name).is_dir())
    for folder in given:
        yield from packages_below(folder).get(name, [])
    yield from (folder / name for folder in package_folders([]) if (folder / name).is_dir())


def package_name(folder: Path) -> str:
    """Return the name in a folder's package.xml; empty if there is none."""
    try:
        found = _NAME.search((folder / MANIFEST).read_bytes()[:65536])
    except OSError:
        return ""
    return found[1].decode("utf-8", "replace") if found else ""


@functools.cache
def packages_below(folder: Path) -> dict[str, list[Path]]:
    """Return the packages in a folder and a few levels below it, by name; the highest ones first."""
    found: dict[str, list[Path]] = {}
    level, visited = [folder], 0
    for _ in range(_DEPTH):
        below: list[Path] = []
        for path in level:
            visited += 1
            if name := package_name(path):
                found.setdefault(name, []).append(path)
            if visited > _MAX_FOLDERS or (name and path != folder):
                continue  # packages do not contain each other
            try:
                inside = sorted(each.name for each in os.scandir(path) if each.is_dir())
            except OSError:
                continue
            below += [path / each for each in inside if each not in _SKIPPED and not each.startswith(".")]
        level = below
    return found


def neighbours(file: Path) -> list[Path]:
    """Return the folders around a description in which its packages are searched, nearest first.

    They are its package, the repository or folder that contains it and the one above, but neither the home folder nor
    a top-level one, where packages of others may be. Without any package.xml it is only the folder of the file.
    """
    parents = file.resolve().parents
    last = max((i for i, folder in enumerate(parents) if (folder / MANIFEST).is_file()), default=None)
    around = [] if last is None else list(parents[last:last + 3])
    stop = next((i for i, each in enumerate(around) if len(each.parts) <= 2 or each == Path.home()), len(around))
    return around[:stop] or [parents[0]]
