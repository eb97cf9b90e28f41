"""Shrink an environment for an image: remove build files, and robots that no robot file uses.

`python deploy/slim.py ENVIRONMENT ROBOTS`, with the folder of a virtual environment and that of the robot files.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

# Headers, build descriptions and programs of the C++ packages, and the tests and types of the Python ones.
BUILD_ONLY = ("cmeel.prefix/include", "cmeel.prefix/bin", "cmeel.prefix/lib/cmake", "cmeel.prefix/lib/pkgconfig",
              "cmeel.prefix/share/doc", "cmeel.prefix/share/man", "pip", "setuptools", "pkg_resources",
              "cmeel.prefix/lib/python3.11/site-packages/hppfcl")
ROBOTS = "cmeel.prefix/share/example-robot-data/robots"


def used_robots(folder: Path) -> set[str]:
    """Return the descriptions that the robot files use, such as panda_description."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.yaml")))
    return set(re.findall(r"package://example-robot-data/robots/(\w+)/", text))


def slim(packages: Path, robots: set[str]) -> None:
    """Remove unused files from a site-packages folder."""
    for name in BUILD_ONLY:
        shutil.rmtree(packages / name, ignore_errors=True)
    for folder in (packages / ROBOTS).iterdir():
        if folder.name not in robots:
            shutil.rmtree(folder)
    for folder in list(packages.rglob("tests")):
        shutil.rmtree(folder, ignore_errors=True)
    for pattern in ("*.a", "*.pyi"):
        for path in packages.rglob(pattern):
            path.unlink()
    for path, same in duplicates(packages):  # wheels contain no links: each name of a library is a copy
        path.unlink()
        path.symlink_to(same.name)


def duplicates(packages: Path) -> Iterator[tuple[Path, Path]]:
    """Yield duplicate shared libraries of a folder: the copy, and the one to keep."""
    seen: dict[tuple[Path, str], Path] = {}
    for path in sorted(packages.rglob("*.so*")):
        if path.is_file() and not path.is_symlink():
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            first = seen.setdefault((path.parent, digest), path)
            if first != path:
                yield path, first


if __name__ == "__main__":
    environment, robot_files = Path(sys.argv[1]), Path(sys.argv[2])
    names = used_robots(robot_files)
    if not names:
        sys.exit(f"no robot file in {robot_files} names a description")
    for site in environment.glob("lib/python*/site-packages"):
        slim(site, names)
