"""Run a module that is no part of zencell as a service: `python -P .../own_module.py -m MODULE --cell CELL ...`.

The module is searched in the folder of the cell file and in the working directory, after all others.
"""

from __future__ import annotations

import runpy
import sys

from common.application import import_from_folder_of
from common.plugins import import_from_working_directory


def run(module: str, arguments: list[str]) -> None:
    """Run a module with these arguments, one of which names the cell."""
    if "--cell" in arguments[:-1]:
        import_from_folder_of(arguments[arguments.index("--cell") + 1])
    import_from_working_directory(module)
    sys.argv[1:] = arguments
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    run(sys.argv[2], sys.argv[3:])
