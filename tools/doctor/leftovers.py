"""Processes of earlier runs: services without a supervisor, and what was stopped and never went on."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tools.doctor.finding import Finding, ok, warn

INITS = ("init", "systemd", "docker-init", "tini", "dumb-init", "catatonit")  # who adopts orphans
STOPPED = ("stopped", "tracing-stop")
STARTING = 30.0  # [s] in which a supervisor may have no process yet
VERBS = ("run", "up", "snapshot")


@dataclass(frozen=True)
class Seen:
    """A process as the system shows it."""

    pid: int
    ppid: int
    name: str
    status: str
    age: float  # [s]
    command: Sequence[str]

    @property
    def is_service(self) -> bool:
        """Whether a supervisor started it."""
        return "--gate" in self.command and "-m" in self.command

    @property
    def is_supervisor(self) -> bool:
        """Whether it is a zencell command that has a cell up."""
        programs = {Path(part).name for part in self.command[:2]} | set(self.command[:4])
        return bool({"zencell", "cli.main"} & programs) and any(verb in self.command for verb in VERBS)


def processes() -> Iterator[Finding]:
    """What is left of earlier runs, and the cells that are up on this host."""
    yield from judge(list(_seen()))


def judge(seen: list[Seen]) -> Iterator[Finding]:
    """What is left of earlier runs among the processes of this host."""
    by_pid = {each.pid: each for each in seen}
    services = [each for each in seen if each.is_service and each.status != "zombie"]
    supervisors = [each for each in seen if each.is_supervisor and each.status != "zombie"]
    orphans = [each for each in services if _is_orphan(each, by_pid)]
    frozen = [each for each in services if each.status in STOPPED and each not in orphans]
    fine = True
    if orphans:
        fine = False
        # What was stopped hears nothing but SIGKILL; the others were asked to end by the death of their supervisor.
        yield warn(f"services without a supervisor: {_listed(orphans)}", f"kill -9 {_pids(orphans)}")
    if frozen:
        fine = False
        yield warn(f"services that are stopped (SIGSTOP): {_listed(frozen)}", f"kill -CONT {_pids(frozen)}")
    for each in supervisors:
        if each.status in STOPPED:
            fine = False
            yield warn(f"a supervisor is stopped (SIGSTOP): {_listed([each])}",
                       f"kill -CONT {each.pid} to let it go on, kill -9 {each.pid} to end it and its cell")
        elif each.age > STARTING and not any(_descends(service, each, by_pid) for service in services):
            fine = False
            yield warn(f"a supervisor without services: {_listed([each])}", f"kill {each.pid}")
        else:
            yield ok(f"a cell is up, or comes up: {_listed([each])}, for {_duration(each.age)}")
    if fine:
        yield ok("no process is left over from an earlier run")


def _is_orphan(service: Seen, by_pid: dict[int, Seen]) -> bool:
    parent = by_pid.get(service.ppid)
    return service.ppid <= 1 or parent is None or parent.name in INITS


def _descends(service: Seen, ancestor: Seen, by_pid: dict[int, Seen]) -> bool:
    at: Seen | None = service
    steps: set[int] = set()
    while at is not None and at.pid not in steps:
        if at.ppid == ancestor.pid:
            return True
        steps.add(at.pid)
        at = by_pid.get(at.ppid)
    return False


def _seen() -> Iterator[Seen]:
    import psutil

    now = time.time()
    for process in psutil.process_iter(["pid", "ppid", "name", "status", "create_time", "cmdline"]):
        facts = process.info
        yield Seen(
            facts["pid"], facts["ppid"] or 0, facts["name"] or "", facts["status"] or "",
            now - (facts["create_time"] or now), tuple(facts["cmdline"] or ()),
        )


def _pids(seen: list[Seen]) -> str:
    return " ".join(str(each.pid) for each in seen)


def _listed(seen: list[Seen]) -> str:
    return ", ".join(f"{_what(each)} ({each.pid})" for each in seen)


def _what(each: Seen) -> str:
    """What a process is, in the words of the command line."""
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
