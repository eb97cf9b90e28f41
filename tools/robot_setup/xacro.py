"""A URDF made of a xacro file, where the tool for that is installed."""

from __future__ import annotations

import importlib
from pathlib import Path

from common.errors import ConfigError
from common.robot.description import find_description


def urdf_of_xacro(reference: str, folder: Path, *, overwrite: bool) -> str:
    """Path of the URDF that was made of a xacro file and written to a folder.

    Raises:
        ConfigError: the tool is not installed, or does not read the file, or a URDF of that name is there already.
    """
    path = find_description("urdf", reference)
    try:
        xacro = importlib.import_module("xacro")
    except ImportError:
        raise ConfigError("urdf", reference, "is a xacro file: pip install xacro, which makes a URDF of it") from None
    try:
        text = xacro.process_file(str(path)).toxml()
    except Exception as error:  # whatever the tool makes of it
        said = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError("urdf", reference, f"is no xacro file that can be read: {said}") from None
    name = path.name.removesuffix(".xacro").removesuffix(".urdf")
    made = folder / f"{name}.urdf"
    if made.exists() and not overwrite:
        raise ConfigError("urdf", reference, f"becomes {made}, which is there already; --force overwrites it")
    made.write_text(text, encoding="utf-8")
    return str(made)
