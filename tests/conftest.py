import os
import shutil
import signal
import tempfile
from itertools import count
from pathlib import Path

from common.process.environment import set_startup_variables

set_startup_variables()  # before numpy is imported, as in every process of a cell

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

# A background job of a script ignores SIGINT, and so would all processes that the tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No deadlines: a busy machine is no failure. Speed is measured by benchmarks.
settings.register_profile("thorough", deadline=None)
# The same few examples each time, so that a failure comes from a change. `make campaign` searches for new ones.
settings.register_profile("quick", deadline=None, max_examples=25, derandomize=True, database=None)


# Persistent state of cells stays in a folder of the test, never in the user's.
STATE_ROOT = Path(tempfile.gettempdir()) / f"zencell-tests-{os.getpid()}"
_number = count()


@pytest.fixture(autouse=True)
def _separate_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(STATE_ROOT / str(next(_number))))
    monkeypatch.delenv("ZENCELL_STATE", raising=False)


def pytest_configure(config: pytest.Config) -> None:
    """Let `make campaign` search for new examples."""
    os.environ["XDG_STATE_HOME"] = str(STATE_ROOT / "shared")
    selected = config.option.markexpr
    campaign = "campaign" in selected and "not campaign" not in selected
    settings.load_profile("thorough" if campaign else "quick")


def pytest_unconfigure() -> None:
    """Remove all state."""
    shutil.rmtree(STATE_ROOT, ignore_errors=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with files of long tests, end with tests/common: the workers get the files in this order."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path not in slow, item.nodeid.startswith("tests/common/")))
