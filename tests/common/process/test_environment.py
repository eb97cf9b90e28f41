import os
import subprocess
import sys
from pathlib import Path

import pytest

from common.process.environment import VARIABLES

ROOT = Path(__file__).resolve().parents[3]
CLEAN = {name: value for name, value in os.environ.items() if name not in VARIABLES}
REPORT = "import os, sys; print([os.environ[name] for name in %r], 'numpy' in sys.modules, 'pydantic' in sys.modules)"


def report_after(start: str, **environment: str) -> str:
    code = f"{start}\n{REPORT % list(VARIABLES)}"
    return subprocess.run([sys.executable, "-c", code], env=CLEAN | environment, cwd=ROOT, capture_output=True,
                          text=True, check=True).stdout.strip()


def test_command_sets_the_variables_before_it_imports_its_verbs():
    report = report_after("import sys, types, zencell.__main__ as command\n"
                      "sys.modules['cli.main'] = types.SimpleNamespace(app=lambda: None)\ncommand.main()")
    assert report == "['1', '__all__'] False False"


def test_service_sets_the_variables_before_numpy_and_pydantic_are_imported():
    assert report_after("import services") == "['1', '__all__'] False False"


def test_variables_of_the_environment_are_not_overwritten():
    assert report_after("import services", OPENBLAS_NUM_THREADS="4") == "['4', '__all__'] False False"


MEASURE = """
from common.process.environment import release_free_memory, use_single_memory_arena
use_single_memory_arena()
def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6
large, small = [], []
for _ in range(3):  # after the first free, malloc takes such large blocks from the arena, too
    for _ in range(60):
        large.append(bytearray(921_600))
        small.append(bytearray(3000))
    large.clear()
before = resident_mb()
release_free_memory()
print(before - resident_mb())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="malloc_trim is part of glibc")
def test_memory_of_queued_images_is_returned_to_the_system():
    report = subprocess.run([sys.executable, "-c", MEASURE], env=CLEAN, cwd=ROOT, capture_output=True, text=True,
                          check=True).stdout
    assert float(report) > 30, "of the 55 MB that were allocated"
