"""Python and the packages: whether they are there, and those that were tested together."""

from __future__ import annotations

import contextlib
import platform
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from common.planning.kernel.library import library_path
from tools.doctor.finding import Finding, fail, ok, warn

INSTALL = "pip install -c constraints.txt -e ."
CONSTRAINTS = Path(__file__).resolve().parents[2] / "constraints.txt"
OLDEST = (3, 11)
_OF_DEVELOPERS = ("dev",)


def python() -> Finding:
    """Whether this Python will do."""
    what = f"Python {platform.python_version()} ({sys.executable})"
    if sys.version_info < OLDEST:
        return fail(what, f"install Python {'.'.join(map(str, OLDEST))} or newer")
    return ok(what)


def packages() -> Iterator[Finding]:
    """Whether what the project needs is installed, in the versions that were tested."""
    try:
        needed = [text for text in requires("zencell") or [] if "extra ==" not in text]
    except PackageNotFoundError:
        yield warn("zencell is not installed, only found", INSTALL)
        return
    tested = constraints()
    found, other = [], []
    for text in needed:
        name = "".join(c if c.isalnum() or c in "-_." else " " for c in text).split()[0]
        try:
            installed = version(name)
        except PackageNotFoundError:
            yield fail(f"package {name} is missing", f"make setup, or {INSTALL}")
            continue
        found.append(f"{name} {installed}")
        if installed != tested.get(_normal(name), installed):
            other.append(f"{name} {installed} (tested: {tested[_normal(name)]})")
    if other:
        yield warn(f"packages other than those tested: {', '.join(other)}", INSTALL)
    else:
        yield ok(f"packages: {', '.join(found)}")


def extras() -> Finding:
    """Which of what is installed on demand is there."""
    found, known = [], []
    with contextlib.suppress(PackageNotFoundError):
        known = requires("zencell") or []
    for text in known:
        name, _, condition = text.partition(";")
        name = "".join(c if c.isalnum() or c in "-_." else " " for c in name).split()[0]
        extra = condition.partition("extra ==")[2].strip(" \"'")
        if extra and extra not in _OF_DEVELOPERS:
            with contextlib.suppress(PackageNotFoundError):
                found.append(f"{name} {version(name)} ({extra})")
    return ok(f"extras: {', '.join(found) or 'none'}")


def kernel() -> Finding:
    """Whether the compiled planning kernel is there."""
    path = library_path()
    if path is None:
        return warn("the planning kernel is not compiled: planning takes many times longer", INSTALL)
    return ok(f"planning kernel: {path.name}")


def constraints(path: Path | None = None) -> dict[str, str]:
    """Versions that were tested together, by package; empty where the file is not there, as in an image."""
    path = path or CONSTRAINTS
    if not path.is_file():
        return {}
    pairs = (line.partition("==") for line in path.read_text(encoding="utf-8").splitlines())
    return {_normal(name): tested.strip() for name, found, tested in pairs if found}


def _normal(name: str) -> str:
    return name.strip().lower().replace("_", "-").replace(".", "-")
