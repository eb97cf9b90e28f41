"""Who comes after all others."""

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from common.process.pace import NICENESS, come_last

linux = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere only processes have a priority")


def priority() -> int:
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


@linux
def test_only_the_thread_that_computes_comes_last() -> None:
    before = priority()
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: (come_last(), priority())[1]).result() == NICENESS
    come_last()  # the main one is everybody's
    assert priority() == before
