"""Room and limits of the machine: memory, processors, disk, open files, clock."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

from common.process import environment
from tools.doctor.finding import Finding, ok, warn

LEAST_MEMORY = 1.0  # [GB]
LEAST_SHM = 64.0  # [MB]
LEAST_DISK = 2.0  # [GB]
RECORDED = 0.6  # [GB per minute] of a recording of all of a cell with its pictures
LEAST_FILES = 256
CELL_LOAD = 0.7  # [cores] that a cell takes at speed 1
LOOK = 0.3  # [s] at how busy the processors are
CLOCK_YEAR = 2024  # the system clock is wrong when it says an earlier year


def shared_memory() -> Finding:
    """Whether /dev/shm has room."""
    try:
        free = shutil.disk_usage("/dev/shm").free / 1e6
    except OSError:
        return ok("no /dev/shm here, and none is needed")
    if free < LEAST_SHM:
        return warn(f"/dev/shm has {free:.0f} MB left",
                    f"remove old files there, or give it {LEAST_SHM:.0f} MB (docker run --shm-size)")
    return ok(f"/dev/shm has {free:.0f} MB left")


def memory() -> Finding:
    """Whether a cell has room in memory, also within the limit of a container."""
    import psutil

    free, limit = psutil.virtual_memory().available / 1e9, ""
    group = group_memory(environment.CONTROL_GROUP)
    if group is not None and group < free:
        free, limit = group, " within the limit of this container"
    what = f"{free:.1f} GB of memory left{limit}"
    if free < LEAST_MEMORY:
        return warn(what, f"a cell needs {LEAST_MEMORY:g} GB: close something{', or raise the limit' if limit else ''}")
    return ok(what)


def group_memory(group: Path) -> float | None:
    """Memory [GB] that is left within the limit of a control group (v2); None without a limit."""
    try:
        most = (group / "memory.max").read_text(encoding="ascii").strip()
        used = (group / "memory.current").read_text(encoding="ascii").strip()
    except OSError:
        return None
    return None if most == "max" else max(0.0, (int(most) - int(used)) / 1e9)


def cores() -> Finding:
    """Whether a cell has room on the processors."""
    import psutil

    count = environment.usable_cores()
    free = max(0.0, count * (1 - psutil.cpu_percent(LOOK) / 100))
    what = f"{count:g} cores, {free:.1f} of them free, load {os.getloadavg()[0]:.1f}"
    if count < 2:
        return warn(what, "two cores are the least for speed 1 and more: use a lower --speed, or a larger machine")
    if free < CELL_LOAD:
        return warn(what, f"a cell takes {CELL_LOAD:g} of a core at speed 1: close what keeps the machine busy")
    return ok(what)


def disk() -> Finding:
    """Whether a recording has room where the person stands."""
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    what = f"{free:.1f} GB of disk left in {Path.cwd()}"
    if free < LEAST_DISK:
        return warn(what, f"a recording with pictures takes {RECORDED:g} GB a minute: make room, or record elsewhere")
    return ok(what)


def open_files() -> Finding:
    """Whether a process may open as many files and connections as it needs."""
    import resource

    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if most != resource.RLIM_INFINITY and most < LEAST_FILES:
        return warn(f"a process may open {most} files", f"ulimit -n {4 * LEAST_FILES}")
    return ok(f"a process may open {'any number of' if most == resource.RLIM_INFINITY else most} files")


def clock() -> Finding:
    """Whether the clock is set and fine enough."""
    now = time.gmtime()
    resolution = time.get_clock_info("monotonic").resolution
    if now.tm_year < CLOCK_YEAR:
        return warn(f"the clock says {now.tm_year}", "set it (timedatectl set-ntp true): stamps are taken from it")
    if resolution > 1e-3:
        return warn(f"the clock ticks every {resolution * 1e3:g} ms",
                    "motion will be uneven: use a kernel with high-resolution timers")
    return ok(f"clock {time.strftime('%Y-%m-%d %H:%M:%S', now)} UTC, monotonic to {resolution * 1e9:g} ns")


def container_engine() -> Finding:
    """Whether the image can be built and run here, which nothing else needs."""
    found = [name for name in ("docker", "podman") if shutil.which(name)]
    return ok(f"{' and '.join(found)} for the image" if found else "no docker or podman: only the image needs one")
