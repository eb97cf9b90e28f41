"""Mesh files that a description names: of packages, relative to it, or on the machine where it was made."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from common.robot.description_file import fault_of
from common.robot.packages import package_paths

SCHEME = "package://"
_LEVELS = 3  # above a description, where its meshes may be


@dataclass
class MeshReferences:
    """What became of the references of a description.

    Attributes:
        missing: collision meshes without a usable file, and why.
        undrawn: visual meshes without one; they are removed, so that a link is drawn by its collision shape.
        moved: paths of another machine, or of packages that are not here, and the file that is used instead.
        packages: folders of the packages that were used, by name.
    """

    missing: dict[str, str] = field(default_factory=dict)
    undrawn: dict[str, str] = field(default_factory=dict)
    moved: dict[str, Path] = field(default_factory=dict)
    packages: dict[str, Path] = field(default_factory=dict)


def resolve_meshes(root: ET.Element, source: Path, folders: Sequence[str]) -> MeshReferences:
    """Set the absolute paths of all meshes of a URDF.

    Args:
        root: its elements, which are changed.
        source: its file; relative paths start there.
        folders: configured folders of packages, searched before the installed ones.
    """
    result, known = MeshReferences(), dict[str, tuple[Path | None, str]]()
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            for mesh in shape.iter("mesh"):
                name = mesh.get("filename", "")
                if name not in known:
                    known[name] = _usable(name, source, folders, result)
                path, fault = known[name]
                if path is not None:
                    mesh.set("filename", str(path))
                if fault and shape.tag == "collision":
                    result.missing[name] = fault
                elif fault:
                    result.undrawn[name] = fault
    for link in root.iter("link"):
        for shape in link.findall("visual"):
            if any(mesh.get("filename", "") in result.undrawn for mesh in shape.iter("mesh")):
                link.remove(shape)
    return result


def _usable(name: str, source: Path, folders: Sequence[str], result: MeshReferences) -> tuple[Path | None, str]:
    path = _located(name, source, folders, result)
    if path is None:
        return None, "is missing"
    try:
        fault = fault_of(path)
    except OSError as error:
        fault = f"cannot be read: {error.strerror}"
    return (None, fault) if fault else (path.resolve(), "")


def _located(name: str, source: Path, folders: Sequence[str], result: MeshReferences) -> Path | None:
    """Return the file of a mesh reference; None if there is none."""
    if name.startswith(SCHEME):
        package, _, rest = name.removeprefix(SCHEME).partition("/")
        if (found := _in_package(package, rest, source, folders, result)) is not None:
            return found
        tails = [(package, rest)]
    else:
        plain = unquote(name.removeprefix("file://")) if name.startswith("file://") else name
        if "://" in plain or not plain:
            return None
        if (path := source.parent / plain).is_file():
            return path
        tails = list(_tails(plain))
    for package, rest in tails:
        near = (path for folder in source.resolve().parents[:_LEVELS] if (path := folder / rest).is_file())
        found = _in_package(package, rest, source, folders, result) or next(near, None)
        if rest and found is not None:
            result.moved[name] = found
            return found
    return None


def _tails(path: str) -> Iterator[tuple[str, str]]:
    """Yield folder names of a path that may be a package, each with the path below it: behind share and src first."""
    parts = PurePosixPath(path.replace("\\", "/")).parts
    named = [i + 1 for i, part in enumerate(parts) if part in ("share", "src")]
    for i in [*reversed(named), *range(len(parts))]:
        if parts[i + 1:]:
            yield parts[i], "/".join(parts[i + 1:])


def _in_package(
    name: str, rest: str, source: Path, folders: Sequence[str], result: MeshReferences
) -> Path | None:
    for folder in package_paths(name, folders, source):
        if rest and (folder / rest).is_file():
            result.packages[name] = folder
            return folder / rest
    return None
