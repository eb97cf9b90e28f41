"""Find plug-ins by name: modules of this project, dotted modules of the user's own, entry points of installed packages.

A package adds a plug-in by an entry point of one of the groups below, for example in its pyproject.toml:

    [project.entry-points."zencell.planners"]
    my_planner = "my_package.my_planner"
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from common.errors import ConfigError, UnknownName

# Packages of this project whose modules are plug-ins of a group. They are names, not imports: common/ depends on none.
PACKAGES = {
    "zencell.applications": ("applications",),
    "zencell.planners": ("common.planning.planners",),
    "zencell.hardware": ("common.hardware", "drivers"),
    "zencell.grippers": ("common.hardware", "drivers"),
    "zencell.cameras": ("drivers",),
    "zencell.io": ("drivers.io",),
    "zencell.worlds": ("common.sim", "drivers"),
    "zencell.generators": (),
    "zencell.page": ("page.layers",),
    "zencell.verbs": (),
}


def import_from_working_directory(module: str) -> None:
    """Let Python import a dotted module from the working directory, after all others, if its package is there.

    Otherwise a file of a stranger there would be imported in place of a package that is not installed.
    """
    here, package = Path.cwd(), module.partition(".")[0]
    if "." in module and ((here / package).is_dir() or (here / f"{package}.py").is_file()):
        extend_path(str(here))


def extend_path(*folders: str) -> None:
    """Let Python import modules from folders, after all others: none hides another one."""
    sys.path.extend(folder for folder in folders if folder not in sys.path)


def find_plugin(group: str, name: str, *, field: str, noun: str, marker: str = "") -> ModuleType:
    """Return the module of a plug-in.

    Args:
        group: an entry point group, a key of `PACKAGES`.
        name: a plain name, or the dotted name of a module.
        field: the configuration field that holds the name, for errors.
        noun: what the plug-in is, for errors.
        marker: an attribute that a module of `PACKAGES` must have to count as a plug-in of this group.

    Raises:
        UnknownName: no plug-in has that plain name; lists the choices.
        ConfigError: the module cannot be imported.
    """
    if not all(part.isidentifier() for part in name.split(".")):
        raise UnknownName(noun, name, plugin_names(group, marker))
    try:
        if "." in name:
            import_from_working_directory(name)
            return importlib.import_module(name)
        for path in _paths(group, name):
            module = importlib.import_module(path)
            if hasattr(module, marker or "__name__"):
                return module
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}.")
        raise ConfigError(field, name, where_searched(name) if missing else f"cannot be imported: {error}") from None
    raise UnknownName(noun, name, plugin_names(group, marker))


def where_searched(name: str) -> str:
    """Return an error text for a dotted module that does not exist: where it was searched."""
    package, _, last = name.rpartition(".")
    while package:
        with suppress(ImportError):
            folders = getattr(importlib.import_module(package), "__path__", None)
            return "is not a module: " + (f"there is no {last} in {' or '.join(folders)}, the package {package}"
                                          if folders else f"{package} is no package")
        package, _, last = package.rpartition(".")
    python = (sys.base_prefix, sys.prefix)
    own = [folder or "." for folder in dict.fromkeys([*sys.path, str(Path.cwd())])
           if not any(Path(folder).is_relative_to(each) for each in python) and not folder.endswith(".zip")]
    return f"is not a module: there is no {last} in {', '.join(own)} or among the installed packages"


def plugin_names(group: str, marker: str = "") -> list[str]:
    """Return the plain names of all plug-ins of a group, sorted."""
    names = {entry.name for entry in entry_points(group=group)}
    for package in PACKAGES[group]:
        for found in pkgutil.iter_modules(importlib.import_module(package).__path__):
            if not marker or hasattr(importlib.import_module(f"{package}.{found.name}"), marker):
                names.add(found.name)
    return sorted(names)


def _paths(group: str, name: str) -> Iterator[str]:
    for package in PACKAGES[group]:
        if importlib.util.find_spec(f"{package}.{name}") is not None:
            yield f"{package}.{name}"
    yield from (entry.value for entry in entry_points(group=group, name=name))
