import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from common.process.environment import NICENESS, VARIABLES, lower_thread_priority

ROOT = Path(__file__).resolve().parents[3]
CLEAN = {name: value for name, value in os.environ.items() if name not in VARIABLES}
REPORT = "import os, sys; print([os.environ[name] for name in %r], 'numpy' in sys.modules, 'pydantic' in sys.modules)"
COMMAND = """
import sys, types, zencell.__main__ as command
sys.modules['cli.main'] = types.SimpleNamespace(app=lambda: None)
command.main()
"""
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="malloc_trim and priorities of threads")


def output_of(code: str, **environment: str) -> str:
    return subprocess.run([sys.executable, "-c", code], env=CLEAN | environment, cwd=ROOT, capture_output=True,
                          text=True, check=True).stdout.strip()


@pytest.mark.parametrize(("start", "given", "threads"), [
    (COMMAND, {}, "1"), ("import services", {}, "1"), ("import services", {"OPENBLAS_NUM_THREADS": "4"}, "4"),
])
def test_missing_variables_are_set_before_other_imports(start: str, given: dict[str, str], threads: str) -> None:
    assert output_of(f"{start}\n{REPORT % list(VARIABLES)}", **given) == f"['{threads}', '__all__'] False False"


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


@linux
def test_memory_of_queued_images_is_returned_to_the_system() -> None:
    assert float(output_of(MEASURE)) > 30, "of the 55 MB that were allocated"


def priority() -> int:
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


@linux
def test_only_the_computing_thread_gets_a_lower_priority() -> None:
    before = priority()
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: (lower_thread_priority(), priority())[1]).result() == NICENESS
    lower_thread_priority()  # without effect on the main thread
    assert priority() == before
