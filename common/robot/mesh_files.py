"""Meshes from files, in metres. A file is checked before C++ code or a reader that may grow without bounds sees it."""

from __future__ import annotations

import functools
import io
import json
import math
import struct
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Sized
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from common.errors import ConfigError

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]

_NAMES = {"dae": "COLLADA", "glb": "binary glTF"}
FORMATS = ("dae", "glb", "obj", "off", "ply", "stl")
_MAX_BYTES = 100_000_000  # two million triangles as STL
_LARGEST = 1e9  # coordinate
_MAX_ELEMENTS = 1_000_000  # of XML
_MAX_PARTS = 10_000  # nodes of a scene
_MAX_SHOWN = 120  # characters of a reader's error
_STL_HEAD, _STL_TRIANGLE = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

T = TypeVar("T", bound=Sized)


class UnusableMesh(ValueError):
    """A file whose content is no mesh within the bounds; the text is for the user."""


def triangles_of(field: str, path: Path) -> Array:
    """Return the corners (n, 3, 3) [m] of all triangles of a file.

    Raises:
        ConfigError: the file is unreadable; names the configuration field that refers to it.
    """
    def read() -> Array:
        data = _checked(path)
        if _suffix(path) == "stl" and (corners := _binary_stl(data)) is not None:
            return corners
        return np.concatenate([np.zeros((0, 3, 3)), *(np.array(part.triangles) for part in _scene(path, data))])

    return _read(field, path, read)


def parts_of(field: str, path: Path) -> list[trimesh.Trimesh]:
    """Return the meshes of a file with their materials, each posed as in its scene, in metres.

    Raises:
        ConfigError: the file is unreadable; names the configuration field that refers to it.
    """
    return _read(field, path, lambda: _scene(path, _checked(path)))


def content_of(field: str, path: Path) -> bytes:
    """Return the content of a mesh file of a known format.

    Raises:
        ConfigError: it cannot be read, or is larger than meshes are.
    """
    return _read(field, path, lambda: _checked(path))


def _read(field: str, path: Path, read: Callable[[], T]) -> T:
    try:
        found = read()
        if not len(found):
            raise UnusableMesh("it has no triangles")  # for example a truncated file
        return found
    except Exception as error:  # the readers of the formats raise any exception on a damaged file
        if isinstance(error, OSError) and error.strerror:
            reason = f": {error.strerror}"
        elif isinstance(error, UnusableMesh | ET.ParseError):
            reason = f": {' '.join(str(error).split())[:_MAX_SHOWN]}"
        else:  # its text describes the reader's code, not the file
            reason = f" as {_NAMES.get(_suffix(path), _suffix(path).upper())}: the file is damaged or of another format"
        raise ConfigError(field, str(path), f"is a mesh that cannot be read{reason}") from None


def _suffix(path: Path) -> str:
    return path.suffix.lower().removeprefix(".")


def _checked(path: Path) -> bytes:
    """Return the content of a file whose format is known and that is no larger than meshes are."""
    suffix = _suffix(path)
    if suffix not in FORMATS:
        raise UnusableMesh(f"unknown format; choices: {', '.join(FORMATS)}")
    if (size := path.stat().st_size) > _MAX_BYTES:
        raise UnusableMesh(f"it has {size / 1e6:.0f} MB, more than {_MAX_BYTES / 1e6:.0f}: simplify it")
    data = path.read_bytes()
    if suffix == "dae" and zipfile.is_zipfile(io.BytesIO(data)):
        raise UnusableMesh("it is an archive, not a .dae: unpack it")
    return data


def _binary_stl(data: bytes) -> Array | None:
    """Return the corners (n, 3, 3) of a binary STL, or None for a text one.

    Raises:
        UnusableMesh: the file ends before its last triangle.
    """
    if len(data) < _STL_HEAD:
        return None
    (count,) = struct.unpack_from("<I", data, _STL_HEAD - 4)
    there = (len(data) - _STL_HEAD) / _STL_TRIANGLE.itemsize
    if there != count and data.lstrip().startswith(b"solid"):
        return None
    if there < count:
        raise UnusableMesh(f"it announces {count} triangles but ends after {math.floor(there)}")
    return _finite(np.array(np.frombuffer(data, _STL_TRIANGLE, count, _STL_HEAD)["corners"], dtype=float))


def _scene(path: Path, data: bytes) -> list[trimesh.Trimesh]:
    """Return the meshes of a file of any format."""
    import trimesh  # takes a third of a second to import

    suffix, unit = _suffix(path), 1.0
    if suffix == "dae":
        unit = _check_collada(data)
    elif suffix == "glb":
        _check_glb(data)
    elif suffix == "stl" and (corners := _binary_stl(data)) is not None:
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        return [trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False)] if len(corners) else []

    class Resolver(trimesh.resolvers.FilePathResolver):
        """Reads what a file refers to, up to the size of a mesh."""

        def get(self, name: str) -> bytes:
            neighbor = path.parent / name
            if not neighbor.is_file() or neighbor.stat().st_size > _MAX_BYTES:
                raise UnusableMesh(f"it refers to {name}, which is missing or too large")
            return neighbor.read_bytes()

    loaded = trimesh.load_scene(io.BytesIO(data), file_type=suffix, process=False, resolver=Resolver(str(path)))
    parts = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    for part in parts:
        part.vertices = _finite(np.asarray(part.vertices, dtype=float)) * unit
    return parts


def _finite(values: Array) -> Array:
    if not (np.abs(values) < _LARGEST).all():  # also without numbers
        raise UnusableMesh(f"a coordinate of it is no number below {_LARGEST:g}")
    return values


def _check_collada(data: bytes) -> float:
    """Return the unit of a COLLADA file [m]. Its axis that points up is ignored, as RViz and Gazebo do.

    Raises:
        UnusableMesh: its unit is unusable, or its nodes refer to each other more often than scenes do.
    """
    if data.count(b"<") > 2 * _MAX_ELEMENTS:
        raise UnusableMesh(f"it has more than {_MAX_ELEMENTS} elements")
    root = ET.fromstring(data)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    nodes = {"#" + element.get("id", ""): element for element in root.iter("node")}

    @functools.cache
    def count(node: ET.Element) -> int:
        """Return the nodes below a node, instances of other nodes included."""
        used = [nodes[each.get("url", "")] for each in node.findall("instance_node") if each.get("url", "") in nodes]
        return 1 + sum(map(count, [*node.findall("node"), *used]))

    try:
        used = sum(count(node) for scene in root.iter("visual_scene") for node in scene.findall("node"))
    except RecursionError:
        raise UnusableMesh("its nodes contain each other, or too many of them") from None
    if used > _MAX_PARTS:
        raise UnusableMesh(f"its scene has more than {_MAX_PARTS} nodes")
    unit = root.find("asset/unit")
    text = "1" if unit is None else unit.get("meter", "1")
    try:
        meters = float(text)
    except ValueError:
        meters = math.nan
    if not 0 < meters < math.inf:
        raise UnusableMesh(f"its unit is {text!r} m")
    return meters


def _check_glb(data: bytes) -> None:
    """Raise UnusableMesh if a glTF file describes more than it holds: its counts are allocated before they are read."""
    length = struct.unpack_from("<I", data, 12)[0]
    head = json.loads(data[20:20 + length])
    if sum(int(each.get("count", 0)) for each in head.get("accessors", [])) > len(data):
        raise UnusableMesh("it announces more values than it has bytes")
    used = [node for each in head.get("nodes", []) for node in each.get("children", [])]
    used += [node for scene in head.get("scenes", []) for node in scene.get("nodes", [])]
    if len(set(used)) < len(used):
        raise UnusableMesh("its nodes are no tree")
