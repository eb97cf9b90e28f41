"""Who comes after all others."""

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from common.process.environment import NICENESS, lower_thread_priority

linux = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere only processes have a priority")


def priority() -> int:
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


@linux
def test_only_the_thread_that_computes_comes_last() -> None:
    before = priority()
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: (lower_thread_priority(), priority())[1]).result() == NICENESS
    lower_thread_priority()  # the main one is everybody's
    assert priority() == before
