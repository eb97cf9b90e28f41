import os
import subprocess
import sys
from pathlib import Path

import pytest

from common.process.environment import VARIABLES

ROOT = Path(__file__).resolve().parents[3]
CLEAN = {name: value for name, value in os.environ.items() if name not in VARIABLES}
SAYS = "import os, sys; print([os.environ[name] for name in %r], 'numpy' in sys.modules, 'pydantic' in sys.modules)"


def said_after(start: str, **environment: str) -> str:
    code = f"{start}\n{SAYS % list(VARIABLES)}"
    return subprocess.run([sys.executable, "-c", code], env=CLEAN | environment, cwd=ROOT, capture_output=True,
                          text=True, check=True).stdout.strip()


def test_command_sets_it_before_any_verb_is_there():
    said = said_after("import sys, types, zencell.__main__ as command\n"
                      "sys.modules['cli.main'] = types.SimpleNamespace(app=lambda: None)\ncommand.main()")
    assert said == "['1', '__all__'] False False"


def test_service_sets_it_before_numpy_and_pydantic_are_there():
    assert said_after("import services") == "['1', '__all__'] False False"


def test_what_the_environment_says_stays():
    assert said_after("import services", OPENBLAS_NUM_THREADS="4") == "['4', '__all__'] False False"


HOLDS = """
from common.process.environment import release_free_memory, use_single_memory_arena
use_single_memory_arena()
def held():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6
large, small = [], []
for _ in range(3):  # what is that large comes from among the rest once the first was given back
    for _ in range(60):
        large.append(bytearray(921_600))
        small.append(bytearray(3000))
    large.clear()
before = held()
release_free_memory()
print(before - held())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="another C library keeps memory in another way")
def test_what_was_there_for_pictures_that_waited_goes_back_to_the_system():
    said = subprocess.run([sys.executable, "-c", HOLDS], env=CLEAN, cwd=ROOT, capture_output=True, text=True,
                          check=True).stdout
    assert float(said) > 30, "of the 55 MB that were there at once"
