"""What a process finds about it: variables that make its start light, and how many processors it may use."""

import ctypes
import os
from pathlib import Path

CONTROL_GROUP = Path("/sys/fs/cgroup")
_ARENA_MAX = -8  # in malloc.h

# Our matrices have six rows: a pool of threads for them costs each process 0.1 CPU seconds as it starts, and gains
# nothing. pydantic reads the metadata of every installed package for plug-ins, of which we use none.
VARIABLES = {"OPENBLAS_NUM_THREADS": "1", "PYDANTIC_DISABLE_PLUGINS": "__all__"}


def start_light() -> None:
    """Set this before numpy and pydantic are loaded; what the environment says already stays."""
    for name, value in VARIABLES.items():
        os.environ.setdefault(name, value)


def share_memory() -> None:
    """Have all threads share one store of memory, where the C library can be told so.

    With stores of their own each keeps what once was in it: of a router what waited for a reader that read nothing, of
    a planner what a plan took on a thread that is hardly used; some MB that stay.
    """
    if (tell := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        tell(_ARENA_MAX, 1)


def give_back() -> None:
    """Give the system what is free between things that are not, where the C library can be told to: in 0.3 ms.

    What was there for pictures that a busy machine had waiting at once would stay otherwise, a megabyte each.
    """
    if (tell := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        tell(0)


def usable_cores() -> float:
    """Processors that this process may use, also within the limit of a control group (v2), as containers have one."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = (CONTROL_GROUP / "cpu.max").read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return count
    return count if quota == "max" else min(count, int(quota) / int(period))
