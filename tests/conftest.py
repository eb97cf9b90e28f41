import signal

import pytest
from hypothesis import settings

# Who is started in the background of a script has Ctrl-C ignored, and so would all that the tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A machine that is busy is no failure: what must be fast has a benchmark.
settings.register_profile("thorough", deadline=None)
# `make test` tries the same few examples each time: what fails there was broken by a change, not drawn by lot.
settings.register_profile("quick", deadline=None, max_examples=25, derandomize=True, database=None)


def pytest_configure(config: pytest.Config) -> None:
    """`make test-all` looks for examples that nobody has tried."""
    settings.load_profile("quick" if "not slow" in config.option.markexpr else "thorough")


LAST = "tests/common/"  # many short ones


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes long: `make test` deals the files out to two workers in this order."""
    items.sort(key=lambda item: item.nodeid.startswith(LAST))
