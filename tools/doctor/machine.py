"""Checks memory, processors, disk, limits and clock of the machine, and processes left by earlier runs."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from common.process import environment
from tools.doctor import Finding, ok, warn

LEAST_MEMORY = 1.0  # [GB]
LEAST_SHM = 64.0  # [MB]
LEAST_DISK = 2.0  # [GB]
RECORDED = 0.6  # [GB per minute] of a recording with images
LEAST_FILES = 256
CELL_LOAD = 0.7  # [cores] load of a cell at speed 1
LOAD_PERIOD = 0.3  # [s] over which processor load is measured
CLOCK_YEAR = 2024  # earlier years mean that the system clock is wrong


def shared_memory() -> Finding:
    """Check free space in /dev/shm."""
    try:
        free = shutil.disk_usage("/dev/shm").free / 1e6
    except OSError:
        return ok("no /dev/shm, and none is needed")
    if free < LEAST_SHM:
        return warn(f"/dev/shm has {free:.0f} MB left",
                    f"remove old files there, or give it {LEAST_SHM:.0f} MB (docker run --shm-size)")
    return ok(f"/dev/shm has {free:.0f} MB left")


def memory() -> Finding:
    """Check free memory, within the limit of a container too."""
    import psutil

    free, limit = psutil.virtual_memory().available / 1e9, ""
    group = group_memory(environment.CONTROL_GROUP)
    if group is not None and group < free:
        free, limit = group, " within the limit of this container"
    what = f"{free:.1f} GB of memory left{limit}"
    if free < LEAST_MEMORY:
        return warn(what, f"a cell needs {LEAST_MEMORY:g} GB: close programs{', or raise the limit' if limit else ''}")
    return ok(what)


def group_memory(group: Path) -> float | None:
    """Return free memory within the limit of a control group (v2) [GB]; None without a limit."""
    try:
        most = (group / "memory.max").read_text(encoding="ascii").strip()
        used = (group / "memory.current").read_text(encoding="ascii").strip()
    except OSError:
        return None
    return None if most == "max" else max(0.0, (int(most) - int(used)) / 1e9)


def cores() -> Finding:
    """Check free processor capacity."""
    import psutil

    count = environment.usable_cores()
    free = max(0.0, count * (1 - psutil.cpu_percent(LOAD_PERIOD) / 100))
    what = f"{count:g} cores, {free:.1f} of them free, load {os.getloadavg()[0]:.1f}"
    if count < 2:
        return warn(what, "speed 1 and more needs two cores: use a lower --speed, or a larger machine")
    if free < CELL_LOAD:
        return warn(what, f"a cell takes {CELL_LOAD:g} of a core at speed 1: close other programs")
    return ok(what)


def disk() -> Finding:
    """Check free disk space for a recording in the working directory."""
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    what = f"{free:.1f} GB of disk left in {Path.cwd()}"
    if free < LEAST_DISK:
        return warn(what, f"a recording with images takes {RECORDED:g} GB a minute: make room, or record elsewhere")
    return ok(what)


def open_files() -> Finding:
    """Check the limit of open files per process."""
    import resource

    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if most != resource.RLIM_INFINITY and most < LEAST_FILES:
        return warn(f"a process may open {most} files", f"ulimit -n {4 * LEAST_FILES}")
    return ok(f"a process may open {'any number of' if most == resource.RLIM_INFINITY else most} files")


def clock() -> Finding:
    """Check time and resolution of the system clock."""
    now = time.gmtime()
    resolution = time.get_clock_info("monotonic").resolution
    if now.tm_year < CLOCK_YEAR:
        return warn(f"the clock says {now.tm_year}", "set it (timedatectl set-ntp true): stamps are taken from it")
    if resolution > 1e-3:
        return warn(f"the clock ticks every {resolution * 1e3:g} ms",
                    "motion will be uneven: use a kernel with high-resolution timers")
    return ok(f"clock {time.strftime('%Y-%m-%d %H:%M:%S', now)} UTC, monotonic to {resolution * 1e9:g} ns")


def container_engine() -> Finding:
    """List container engines, which only the image needs."""
    found = [name for name in ("docker", "podman") if shutil.which(name)]
    return ok(f"{' and '.join(found)} for the image" if found else "no docker or podman; only the image needs one")


INITS = ("init", "systemd", "docker-init", "tini", "dumb-init", "catatonit")  # parents of orphans
STOPPED = ("stopped", "tracing-stop")
STARTING = 30.0  # [s] after which a supervisor must have services
VERBS = ("run", "up", "snapshot")


@dataclass(frozen=True)
class Process:
    """A process of this host."""

    pid: int
    ppid: int
    name: str
    status: str
    age: float  # [s]
    command: Sequence[str]

    @property
    def is_service(self) -> bool:
        """Whether a supervisor started the process."""
        return "--gate" in self.command and "-m" in self.command

    @property
    def is_supervisor(self) -> bool:
        """Whether the process is a zencell command that runs a cell."""
        programs = {Path(part).name for part in self.command[:2]} | set(self.command[:4])
        return bool({"zencell", "cli.main"} & programs) and any(verb in self.command for verb in VERBS)


def processes() -> Iterator[Finding]:
    """Check for processes left by earlier runs, and list running cells."""
    yield from process_findings(list(_processes()))


def process_findings(seen: list[Process]) -> Iterator[Finding]:
    """Yield findings about the processes of this host."""
    by_pid = {each.pid: each for each in seen}
    services = [each for each in seen if each.is_service and each.status != "zombie"]
    supervisors = [each for each in seen if each.is_supervisor and each.status != "zombie"]
    orphans = [each for each in services if _is_orphan(each, by_pid)]
    frozen = [each for each in services if each.status in STOPPED and each not in orphans]
    fine = True
    if orphans:
        fine = False
        # Stopped processes react to SIGKILL only; the others were to end with their supervisor.
        yield warn(f"services without a supervisor: {_listed(orphans)}", f"kill -9 {_pids(orphans)}")
    if frozen:
        fine = False
        yield warn(f"services that are stopped (SIGSTOP): {_listed(frozen)}", f"kill -CONT {_pids(frozen)}")
    for each in supervisors:
        if each.status in STOPPED:
            fine = False
            yield warn(f"a supervisor is stopped (SIGSTOP): {_listed([each])}",
                       f"kill -CONT {each.pid} to continue it, kill -9 {each.pid} to end it and its cell")
        elif each.age > STARTING and not any(_descends(service, each, by_pid) for service in services):
            fine = False
            yield warn(f"a supervisor without services: {_listed([each])}", f"kill {each.pid}")
        else:
            yield ok(f"a cell runs or starts: {_listed([each])}, for {_duration(each.age)}")
    if fine:
        yield ok("no process is left from an earlier run")


def _is_orphan(service: Process, by_pid: dict[int, Process]) -> bool:
    parent = by_pid.get(service.ppid)
    return service.ppid <= 1 or parent is None or parent.name in INITS


def _descends(service: Process, ancestor: Process, by_pid: dict[int, Process]) -> bool:
    at: Process | None = service
    steps: set[int] = set()
    while at is not None and at.pid not in steps:
        if at.ppid == ancestor.pid:
            return True
        steps.add(at.pid)
        at = by_pid.get(at.ppid)
    return False


def _processes() -> Iterator[Process]:
    import psutil

    now = time.time()
    for process in psutil.process_iter(["pid", "ppid", "name", "status", "create_time", "cmdline"]):
        facts = process.info
        yield Process(
            facts["pid"], facts["ppid"] or 0, facts["name"] or "", facts["status"] or "",
            now - (facts["create_time"] or now), tuple(facts["cmdline"] or ()),
        )


def _pids(seen: list[Process]) -> str:
    return " ".join(str(each.pid) for each in seen)


def _listed(seen: list[Process]) -> str:
    return ", ".join(f"{_what(each)} ({each.pid})" for each in seen)


def _what(each: Process) -> str:
    """Return the service or command of a process."""
    if each.is_service:
        module, option, name, *_ = (*each.command[list(each.command).index("-m") + 1:], "", "")
        return name if option == "--name" else module.rpartition(".")[2]
    verb = next(index for index, part in enumerate(each.command) if part in VERBS)
    return " ".join(("zencell", *each.command[verb : verb + 2]))


def _duration(seconds: float) -> str:
    for size, name in ((86400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{seconds:.0f} s"
