"""Cameras that are plugged in, and whether what reads them is installed."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from tools.doctor.finding import Finding, ok, warn

SYS = Path("/sys")
# By maker and, where the maker makes other things too, a word of the product: what it is, its driver and its package.
DEPTH_CAMERAS = (
    ("8086", "realsense", "RealSense", "realsense", "pyrealsense2"),
    ("03e7", "", "OAK", "oak", "depthai"),  # the chip of a Luxonis camera, by Intel Movidius
)


def cameras(sys: Path = SYS) -> Iterator[Finding]:
    """What is plugged in, as Linux tells it; nothing on other systems.

    Args:
        sys: where sysfs is.
    """
    depth = dict(_depth_cameras(sys))
    yield from depth.values()
    for path in sorted((sys / "class/video4linux").glob("video*"), key=lambda path: (len(path.name), path.name)):
        if any((path / "device").resolve().is_relative_to(camera) for camera in depth):
            continue  # told already, with the driver that reads all of it
        if _read(path / "index") in ("", "0"):  # others of the same camera give no pictures
            yield ok(f"camera /dev/{path.name}: {_read(path / 'name') or 'without a name'} (camera_opencv)")


def _depth_cameras(sys: Path) -> Iterator[tuple[Path, Finding]]:
    """Where each is in sysfs, and what there is to say of it."""
    for path in sorted((sys / "bus/usb/devices").glob("*")):
        maker, product = _read(path / "idVendor"), _read(path / "product")
        for vendor, word, what, driver, package in DEPTH_CAMERAS:
            if maker != vendor or word not in product.lower():
                continue
            told = " ".join(part for part in (what, product, _read(path / "serial")) if part)
            if find_spec(package) is None:
                found = warn(f"depth camera {told}: {package} is not installed",
                             f"pip install 'zencell[{driver}]' for driver: {driver} of real_depth_camera")
            else:
                found = ok(f"depth camera {told} (driver: {driver} of real_depth_camera)")
            yield path.resolve(), found


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
