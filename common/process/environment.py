"""The environment of a process: variables for a fast start, memory of the C library, processors, thread priority."""

import contextlib
import ctypes
import os
import sys
import threading
from pathlib import Path

CONTROL_GROUP = Path("/sys/fs/cgroup")
_ARENA_MAX = -8  # M_ARENA_MAX of malloc.h
NICENESS = 5  # of a thread that computes for long

# Our matrices have six rows: a thread pool for them costs each process 0.1 CPU seconds at start and gains nothing.
# pydantic would read the metadata of every installed package to find plug-ins, of which we use none.
VARIABLES = {"OPENBLAS_NUM_THREADS": "1", "PYDANTIC_DISABLE_PLUGINS": "__all__"}


def set_startup_variables() -> None:
    """Set variables that must be set before numpy and pydantic are imported; variables that are set already stay."""
    for name, value in VARIABLES.items():
        os.environ.setdefault(name, value)


def use_single_memory_arena() -> None:
    """Make all threads share one malloc arena, where the C library supports it.

    An arena keeps its peak size. With one per thread a router would keep the messages once queued for a stalled
    reader, and a planner the memory of a plan on a rarely used thread: several MB each.
    """
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_ARENA_MAX, 1)


def release_free_memory() -> None:
    """Return free memory to the system, where the C library supports it; takes 0.3 ms.

    Otherwise the memory of images that queued up on a busy machine would stay allocated, a megabyte each.
    """
    if (malloc_trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        malloc_trim(0)


def usable_cores() -> float:
    """Return the number of processors for this process, within the limit of its control group (v2) in containers."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = (CONTROL_GROUP / "cpu.max").read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return count
    return count if quota == "max" else min(count, int(quota) / int(period))


def lower_thread_priority() -> None:
    """Lower the priority of this thread unless it is the main thread, so that images are processed first."""
    if sys.platform == "linux" and threading.current_thread() is not threading.main_thread():
        with contextlib.suppress(OSError):  # on other systems only whole processes have a priority
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
