"""All checks of a machine in order of importance; Python, packages, kernel, cameras, robot and cell files."""

from __future__ import annotations

import contextlib
import importlib
import os
import platform
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path

from common.planning.kernel.library import library_path
from tools.doctor import Finding, fail, machine, network, ok, warn


def examine(endpoint: str) -> Iterator[Finding]:
    """Yield all findings; router and cells are checked at an endpoint."""
    yield python()
    yield from packages()
    yield extras()
    yield kernel()
    yield from robots()
    yield from cells()
    yield network.router(endpoint)
    yield from network.versions(endpoint)
    yield from network.clocks(endpoint)
    yield from network.certificates()
    yield network.page()
    yield from cameras()
    yield from machine.processes()
    yield machine.shared_memory()
    yield machine.memory()
    yield machine.cores()
    yield machine.disk()
    yield machine.open_files()
    yield machine.clock()
    yield machine.container_engine()


def robots() -> Iterator[Finding]:
    """Check that every robot file is valid and its description exists."""
    from common.config import RobotConfig, check, config_root, names_of, read_robot
    from common.errors import ZencellError

    for name in names_of("robots"):
        try:
            robot = check(RobotConfig, read_robot(config_root() / "robots" / f"{name}.yaml"))
            needed = [robot.urdf, robot.srdf, *(attachment.urdf for attachment in robot.attachments)]
            missing = [text for text in needed if text and not _described(text, robot.package_dirs)]
        except ZencellError as error:
            yield fail(f"robot {name}: {error}", f"correct {config_root() / 'robots' / f'{name}.yaml'}")
            continue
        if missing:
            yield fail(f"robot {name}: {missing[0]} is missing", "pip install example-robot-data, or correct its path")
        else:
            yield ok(f"robot {name}: description present")


def _described(uri: str, package_dirs: list[str]) -> bool:
    """Return whether a robot description exists, without importing robotics packages."""
    if not uri.startswith("package://"):
        return Path(uri).expanduser().is_file()
    relative = uri.removeprefix("package://")
    roots = [Path(text).expanduser() for text in package_dirs]
    for entry in sys.path:
        roots.append(Path(entry) / "cmeel.prefix" / "share")
    return any((root / relative).is_file() for root in roots)


def cells() -> Iterator[Finding]:
    """Check that every cell is valid, with the parameters of all its services."""
    from common.config import config_root, names_of

    root = config_root()
    given = " (ZENCELL_CONFIG)" if "ZENCELL_CONFIG" in os.environ else ""
    if not root.is_dir():
        yield fail(f"the configuration {root}{given} is not a folder", "set ZENCELL_CONFIG to one, or unset it")
        return
    names = names_of("cells")
    if not names:
        yield fail(f"no cell in {root / 'cells'}{given}", "put a cell file there, or give zencell run the path of one")
    for name in names:
        yield cell(name)


def cell(name: str) -> Finding:
    """Check that a cell is valid, with the parameters of all its services."""
    from common.config import config_root, load_cell, service_config
    from common.errors import ZencellError
    from common.supervision.launch import require_module

    file = config_root() / "cells" / f"{name}.yaml"
    try:
        loaded = load_cell(name)
        for key, entry in loaded.services.items():
            require_module(key, entry)
            service_config(loaded, entry.name, importlib.import_module(entry.module).Config)
    except ZencellError as error:
        return fail(f"cell {name}: {error}", f"correct {file}")
    except Exception as error:  # a module of the user may raise anything
        return fail(f"cell {name}: services cannot be imported: {error!r}", "install what is missing, or correct it")
    return ok(f"cell {name}: {len(loaded.services)} services, all parameters valid")


INSTALL = "pip install -c constraints.txt -e ."
CONSTRAINTS = Path(__file__).resolve().parents[2] / "constraints.txt"
OLDEST = (3, 11)
_OF_DEVELOPERS = ("dev",)


def python() -> Finding:
    """Check the Python version."""
    what = f"Python {platform.python_version()} ({sys.executable})"
    if sys.version_info < OLDEST:
        return fail(what, f"install Python {'.'.join(map(str, OLDEST))} or newer")
    return ok(what)


def packages() -> Iterator[Finding]:
    """Check that all dependencies are installed in the tested versions."""
    try:
        needed = [text for text in requires("zencell") or [] if "extra ==" not in text]
    except PackageNotFoundError:
        yield warn("zencell is importable but not installed", INSTALL)
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
    """List installed extras."""
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
    """Check that the planning kernel is compiled."""
    path = library_path()
    if path is None:
        return warn("the planning kernel is not compiled: planning takes many times longer", INSTALL)
    return ok(f"planning kernel: {path.name}")


def constraints(path: Path | None = None) -> dict[str, str]:
    """Return the tested version by package; empty if the file does not exist, as in an image."""
    path = path or CONSTRAINTS
    if not path.is_file():
        return {}
    pairs = (line.partition("==") for line in path.read_text(encoding="utf-8").splitlines())
    return {_normal(name): tested.strip() for name, found, tested in pairs if found}


def _normal(name: str) -> str:
    return name.strip().lower().replace("_", "-").replace(".", "-")


SYS = Path("/sys")
# USB vendor and, if it makes other devices too, a word of the product name: label, driver and package.
DEPTH_CAMERAS = (
    ("8086", "realsense", "RealSense", "realsense", "pyrealsense2"),
    ("03e7", "", "OAK", "oak", "depthai"),  # the chip of a Luxonis camera, by Intel Movidius
)


def cameras(sys: Path = SYS) -> Iterator[Finding]:
    """List plugged-in cameras on Linux; none on other systems.

    Args:
        sys: mount point of sysfs.
    """
    depth = dict(_depth_cameras(sys))
    yield from depth.values()
    for path in sorted((sys / "class/video4linux").glob("video*"), key=lambda path: (len(path.name), path.name)):
        if any((path / "device").resolve().is_relative_to(camera) for camera in depth):
            continue  # listed already
        if _read(path / "index") in ("", "0"):  # other nodes of a camera give no images
            yield ok(f"camera /dev/{path.name}: {_read(path / 'name') or 'without a name'} (camera_opencv)")


def _depth_cameras(sys: Path) -> Iterator[tuple[Path, Finding]]:
    """Yield path in sysfs and finding of each depth camera."""
    for path in sorted((sys / "bus/usb/devices").glob("*")):
        maker, product = _read(path / "idVendor"), _read(path / "product")
        for vendor, word, what, driver, package in DEPTH_CAMERAS:
            if maker != vendor or word not in product.lower():
                continue
            name = " ".join(part for part in (what, product, _read(path / "serial")) if part)
            if find_spec(package) is None:
                found = warn(f"depth camera {name}: {package} is not installed",
                             f"pip install 'zencell[{driver}]' for driver: {driver} of real_depth_camera")
            else:
                found = ok(f"depth camera {name} (driver: {driver} of real_depth_camera)")
            yield path.resolve(), found


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
