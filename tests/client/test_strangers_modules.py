"""Files of the working directory or next to a cell never replace modules of Python, of packages or of zencell."""

import os
import subprocess
from pathlib import Path

from common.supervision.launch import Launch, module_command, pythonpath

TRAPS = ("sitecustomize", "usercustomize", "numpy", "json", "xxhash", "mujoco", "yaml")
SHOW = """
import json, sys
import numpy, yaml
from common.plugins import find_plugin
find_plugin("zencell.planners", "my_pkg.mine", field="x", noun="planner")
import my_pkg.mine
print("loaded", sys.argv[1:], numpy.__version__ > "1", my_pkg.mine.HERE)
"""


def test_strangers_files_are_not_imported_and_own_modules_are(tmp_path: Path) -> None:
    for name in TRAPS:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'sprung')!r}, 'a').write('{name} ')\n")
    (tmp_path / "my_pkg").mkdir()
    (tmp_path / "my_pkg" / "mine.py").write_text("HERE = True\n")
    (tmp_path / "my_pkg" / "service.py").write_text(SHOW)
    environment = {**os.environ, "PYTHONPATH": pythonpath({"PYTHONPATH": ""})}
    launch = Launch(str(tmp_path / "cell.yaml"))
    own = [*module_command("my_pkg.service"), "--cell", launch.cell]
    assert own[own.index("-m") + 1] == "my_pkg.service"
    cells = [*module_command("cli.main"), "cells"]
    for command, expected in ((own, f"loaded ['--cell', '{launch.cell}'] True True"), (cells, "panda")):
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert expected in done.stdout, done.stderr
    assert not (tmp_path / "sprung").exists()
