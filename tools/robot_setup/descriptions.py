"""Descriptions as their makers ship them: URDFs and xacro files, with the packages that they name."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from common.errors import ConfigError
from common.robot.description_file import parse_xml, read_xml
from common.robot.mesh_references import SCHEME, resolve_meshes
from common.robot.packages import neighbours, package_name, package_paths
from common.robot.urdf import find_description
from common.terminal import printable

_SECONDS = 60  # of waiting for a xacro file on a busy machine
_MAX_SHOWN = 300  # characters of what a file states
_TAGS = ("link", "joint", "material")
_TRUST = ". If you trust the author, --trust evaluates it with all of Python"
_WORKER = Path(__file__).with_name("xacro_worker.py")


@dataclass
class Description:
    """A parsed description.

    Attributes:
        root: its elements, meshes with absolute paths.
        expanded: it was a xacro file.
        packages: folders of its packages, by name.
        notes: what was changed, for the user.
    """

    root: ET.Element
    expanded: bool = False
    packages: dict[str, Path] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@dataclass
class Reader:
    """Reads descriptions.

    Attributes:
        given: folders of `--package-dir`; found: those that descriptions need in addition.
        arguments: of xacro files; asked: those that some file asked for.
        trust: evaluate expressions of xacro files with all of Python.
    """

    given: list[str]
    arguments: Mapping[str, str] = field(default_factory=dict)
    trust: bool = False
    asked: set[str] = field(default_factory=set)
    found: list[str] = field(default_factory=list)

    @property
    def folders(self) -> list[str]:
        """All folders in which packages are found."""
        return [*self.given, *self.found]

    def read(self, option: str, reference: str) -> Description:
        """Return a description; its collision meshes exist.

        Raises:
            ConfigError: it cannot be read, or lacks a package or a mesh; names the option.
        """
        path = find_description(option, reference, self.folders)
        around = [*self.folders, *map(str, neighbours(path))]
        if is_xacro(path):
            reply = self._expanded(option, reference, path, around)
            found = Description(parse_xml(option, reference, reply["text"].encode()), True)
            found.packages = {name: Path(folder) for name, folder in reply["packages"].items()}
        else:
            found = Description(read_xml(option, path))
        meshes = resolve_meshes(found.root, path, around)
        found.packages |= {name: folder.resolve() for name, folder in meshes.packages.items()}
        if meshes.missing:
            fault = next(iter(meshes.missing.values()))
            advice = "" if "lfs" in fault else "; --package-dir DIR names a folder with its package"
            raise ConfigError(option, reference, f"needs the mesh {_first(meshes.missing)} for collision checks, which "
                                                 f"{fault}{advice}")
        if meshes.moved:
            used = next(iter(meshes.moved.values()))
            found.notes.append(f"{_first(meshes.moved)} is not on this machine: {used} is used")
        if meshes.undrawn:
            fault = next(iter(meshes.undrawn.values()))
            found.notes.append(f"mesh {_first(meshes.undrawn)} {fault}: the link is drawn by its collision shape")
        for name, folder in found.packages.items():
            if not any(each.resolve() == folder for each in package_paths(name, self.folders)):
                self.found.append(str(folder if package_name(folder) == name else folder.parent))
        return found

    def _expanded(self, option: str, reference: str, path: Path, around: Sequence[str]) -> dict[str, Any]:
        """Return the text of a xacro file, and the packages that it asked for."""
        here = str(Path.cwd())
        request = {"file": str(path), "arguments": dict(self.arguments), "folders": list(around), "trust": self.trust,
                   "readable": [*self.given, str(path), *_own_folders(path),
                                *(os.path.abspath(each) for each in self.arguments.values() if os.path.isfile(each))],
                   "root": str(_WORKER.parents[2]), "python": [each for each in sys.path if each not in ("", here)]}
        # A file of a stranger gets no variables but those that find packages.
        environment = os.environ if self.trust else {
            key: os.environ[key] for key in ("AMENT_PREFIX_PATH",) if key in os.environ}
        try:
            done = subprocess.run([sys.executable, "-I", "-B", str(_WORKER)], input=json.dumps(request), text=True,
                                  capture_output=True, timeout=_SECONDS, env=environment, check=False)
        except subprocess.TimeoutExpired:
            raise ConfigError(option, reference, f"takes more than {_SECONDS} s to expand") from None
        if done.returncode:
            if "No module named 'xacro'" in done.stderr:
                raise ConfigError(option, reference, "is a xacro file: pip install xacro, which expands it")
            last = done.stderr.strip().splitlines()[-1:] or [""]
            how = f"could not be expanded: {last[0]}"
            if done.returncode < 0:  # killed at a limit of the worker
                how = "needs more than 10 s of processor time, or too much memory"
            raise ConfigError(option, reference, f"is a xacro file that {how}")
        reply: dict[str, Any] = json.loads(done.stdout)
        self.asked |= set(reply.get("asked", ()))
        if "error" in reply:
            advice = _TRUST if reply.get("refused") and not self.trust else ""
            reason = printable(" ".join(reply["error"].split()))[:_MAX_SHOWN]
            raise ConfigError(option, reference, f"is a xacro file that {reason}{advice}")
        return reply

    def check_arguments(self) -> None:
        """Check that some file asked for each argument.

        Raises:
            ConfigError: an argument is unknown; lists the choices.
        """
        for name in self.arguments:
            if name not in self.asked:
                raise ConfigError("arguments", f"{name}:={self.arguments[name]}", "is an argument that no xacro file "
                                  f"asks for; choices: {', '.join(sorted(self.asked)) or 'none, it has no arguments'}")


def _own_folders(path: Path) -> list[str]:
    """Return the folder of a file and that of its clone, but not the home folder."""
    clone = [each for each in path.parents if (each / ".git").exists()]
    return [str(each) for each in (path.parent, *clone[:1]) if each != Path.home()]


def is_xacro(path: Path) -> bool:
    """Return whether a file is written in xacro, by its name or content."""
    if path.suffix == ".xacro":
        return True
    with contextlib.suppress(OSError), path.open("rb") as file:
        return re.search(rb"<xacro:\w", file.read(1_000_000)) is not None
    return False


def existing_folders(given: Sequence[str]) -> list[str]:
    """Return the absolute paths of `--package-dir`.

    Raises:
        ConfigError: one is no folder.
    """
    for each in given:
        if not Path(each).expanduser().is_dir():
            raise ConfigError("--package-dir", each, "is not a folder")
    return [str(Path(each).expanduser().resolve()) for each in given]


def parse_arguments(given: Sequence[str]) -> dict[str, str]:
    """Return the values of `name:=value` arguments.

    Raises:
        ConfigError: one has another form.
    """
    found = {}
    for each in given:
        name, assigned, value = each.partition(":=")
        if not assigned or not name:
            raise ConfigError("arguments", each, "must be name:=value, an argument of the xacro file")
        found[name] = value
    return found


@contextlib.contextmanager
def written(description: Description, path: Path, overwrite: bool) -> Iterator[str]:
    """Write an expanded description as a URDF; remove it again if what follows fails.

    Raises:
        ConfigError: the file exists.
    """
    if path.exists() and not overwrite:
        raise ConfigError("--out", str(path), "is there already; --force overwrites it")
    path.write_text(_portable(description, path.parent), encoding="utf-8")
    try:
        yield str(path)
    except BaseException:
        path.unlink()
        raise


def _portable(description: Description, folder: Path) -> str:
    """Return a URDF whose meshes are named by package, or relative to the folder of the file."""
    root = ET.fromstring(ET.tostring(description.root))
    for element in [each for each in root if each.tag not in _TAGS]:
        root.remove(element)
    for mesh in root.iter("mesh"):
        if (path := Path(mesh.get("filename", ""))).is_file():
            package = next(((name, path.relative_to(at)) for name, at in description.packages.items()
                            if path.is_relative_to(at)), None)
            mesh.set("filename", f"{SCHEME}{package[0]}/{package[1].as_posix()}" if package else
                     Path(os.path.relpath(path, folder.resolve())).as_posix())
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _first(names: Mapping[str, object]) -> str:
    more = f" (and {len(names) - 1} more)" if len(names) > 1 else ""
    return f"{printable(next(iter(names)))[:_MAX_SHOWN]}{more}"
