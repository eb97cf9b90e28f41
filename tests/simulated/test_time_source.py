"""Simulated code takes time and ids from common/time_source.py only."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("common/control", "common/hardware", "common/planning", "common/perception", "common/robot", "common/scene",
         "common/sim", "common/tasks", "applications")
SINGLE = (
    "common/clock.py", "common/process/task_runner.py", "common/process/task_requests.py", "common/process/timing.py",
    "common/transport/bus.py", "common/transport/reader.py", "common/transport/writer.py",
    "common/transport/requests.py", "common/transport/tokens.py",
    "common/supervision/supervisor.py", "common/supervision/lifecycle.py",
)
REAL = tuple(f"common/{name}.py" for name in (  # of real arms and cameras, which no simulation has
    "hardware/driven_arm", "hardware/driver_process", "hardware/driven_gripper"))
REAL += ("applications/programming/scripted.py",)  # of exported scripts, which wait in a process of the operator
REAL_SOURCES = {"time", "uuid", "secrets", "random", "datetime"}


def test_simulated_code_takes_time_and_ids_from_the_time_source():
    files = [path for room in FOLDERS for path in (ROOT / room).rglob("*.py")]
    files += [ROOT / name for name in SINGLE]
    files = [path for path in files if str(path.relative_to(ROOT)) not in REAL]
    assert len(files) > 80
    found = []
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = {alias.name for alias in node.names}
            else:
                names = {node.module or ""} if isinstance(node, ast.ImportFrom) else set()
            found += [f"{path.relative_to(ROOT)}:{node.lineno} imports {name}" for name in names & REAL_SOURCES]
    assert found == []
