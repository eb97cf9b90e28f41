"""What a process finds about it: variables that make its start light, and how many processors it may use."""

import os
from pathlib import Path

CONTROL_GROUP = Path("/sys/fs/cgroup")

# Our matrices have six rows: a pool of threads for them costs each process 0.1 CPU seconds as it starts, and gains
# nothing. pydantic reads the metadata of every installed package for plug-ins, of which we use none.
VARIABLES = {"OPENBLAS_NUM_THREADS": "1", "PYDANTIC_DISABLE_PLUGINS": "__all__"}


def start_light() -> None:
    """Set this before numpy and pydantic are loaded; what the environment says already stays."""
    for name, value in VARIABLES.items():
        os.environ.setdefault(name, value)


def usable_cores() -> float:
    """Processors that this process may use, also within the limit of a control group (v2), as containers have one."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = (CONTROL_GROUP / "cpu.max").read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return count
    return count if quota == "max" else min(count, int(quota) / int(period))
