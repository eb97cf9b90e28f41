import os
import shutil
import signal
import tempfile
from itertools import count
from pathlib import Path

import pytest
from hypothesis import settings

# Who is started in the background of a script has Ctrl-C ignored, and so would all that the tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A machine that is busy is no failure: what must be fast has a benchmark.
settings.register_profile("thorough", deadline=None)
# `make test` tries the same few examples each time: what fails there was broken by a change, not drawn by lot.
settings.register_profile("quick", deadline=None, max_examples=25, derandomize=True, database=None)


# What persons decide in a cell outlives every process, but not the test: no folder of one's own is ever touched.
KEPT = Path(tempfile.gettempdir()) / f"zencell-tests-{os.getpid()}"
_number = count()


@pytest.fixture(autouse=True)
def _kept_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(KEPT / str(next(_number))))
    monkeypatch.delenv("ZENCELL_STATE", raising=False)


def pytest_configure(config: pytest.Config) -> None:
    """`make test-all` looks for examples that nobody has tried."""
    os.environ["XDG_STATE_HOME"] = str(KEPT / "shared")
    settings.load_profile("quick" if "not slow" in config.option.markexpr else "thorough")


def pytest_unconfigure() -> None:
    """Leave nothing behind."""
    shutil.rmtree(KEPT, ignore_errors=True)


LAST = "tests/common/"  # many short ones


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes long: `make test` deals the files out to two workers in this order."""
    items.sort(key=lambda item: item.nodeid.startswith(LAST))
