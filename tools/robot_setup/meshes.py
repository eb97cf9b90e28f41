"""Where the meshes of a description lie."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from common.errors import ConfigError
from common.robot.description import SCHEME, find_description, package_folders
from common.robot.merging import read_urdf


def folders_of_meshes(field: str, urdf: str, configured: Sequence[str], source: str = "") -> list[str]:
    """Folders above a URDF, or above the file that it was made of, that hold packages which are not found otherwise.

    Raises:
        ConfigError: a mesh is nowhere.
    """
    root = read_urdf(field, urdf, configured)
    above = find_description(field, source or urdf, configured).parents
    found: list[str] = []
    missing: list[str] = []
    for name in dict.fromkeys(mesh.get("filename", "") for mesh in root.iter("mesh")):
        inside = name.removeprefix(SCHEME)
        if not name.startswith(SCHEME):
            path = Path(name.removeprefix("file://"))
            missing += [] if path.is_file() else [name]
        elif not any((folder / inside).is_file() for folder in package_folders([*configured, *found])):
            holder = next((folder for folder in above if (folder / inside).is_file()), None)
            if holder is None:
                missing.append(name)
            else:
                found.append(str(holder))
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ConfigError(field, urdf, f"has meshes that are not there: {missing[0]}{more}; --package-dir DIR names "
                                       "the folder that holds their package")
    return found
