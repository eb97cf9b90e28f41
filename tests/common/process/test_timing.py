"""Thread priorities."""

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from common.process.environment import NICENESS, lower_thread_priority

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has priorities of threads")


def priority() -> int:
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


@linux
def test_only_the_computing_thread_gets_a_lower_priority() -> None:
    before = priority()
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: (lower_thread_priority(), priority())[1]).result() == NICENESS
    lower_thread_priority()  # without effect on the main thread
    assert priority() == before
