import signal

import pytest
from hypothesis import settings

# Who is started in the background of a script has Ctrl-C ignored, and so would all that the tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A machine that is busy is no failure: what must be fast has a benchmark.
settings.register_profile("zencell", deadline=None)
settings.load_profile("zencell")

LAST = "tests/common/"  # many short ones: they fill up what is left when the long ones have been dealt out


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """With `pytest -n 2 --dist loadgroup` a file stays with one worker, because its tests share a cell."""
    if not hasattr(config, "workerinput"):
        return
    items.sort(key=lambda item: item.nodeid.startswith(LAST))
    for item in items:
        item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))
