import resource
import shlex
import shutil
import socket
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from cli.main import app
from common.errors import DecodeError
from common.process import environment
from common.transport.local import LocalNetwork
from tests.harness import Zencell
from tools.doctor import Finding, examination, machine, network, software
from tools.doctor.examination import examine
from tools.doctor.machine import Process, process_findings

Disk = namedtuple("Disk", "total used free")
NOWHERE = "tcp/127.0.0.1:1"
SERVICE = (sys.executable, "-P", "-m", "services.vision_detector", "--cell", "panda", "--domain", "42", "--gate")
RUNNING = (sys.executable, "/usr/bin/zencell", "up", "panda")


@pytest.fixture
def listener() -> Iterator[int]:
    """A port at which something listens that is not ours."""
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        yield holder.getsockname()[1]


def not_well(finding: Finding, *parts: str, level: str = "warn") -> None:
    """A finding that is shown with all of the parts, and says what to do."""
    assert finding.level == level
    assert finding.remedy
    for part in parts:
        assert part in f"{finding.what}: {finding.remedy}"


def test_this_machine_is_examined_and_what_is_not_well_has_a_remedy() -> None:
    findings = list(examine(NOWHERE))
    assert len(findings) > 12
    for finding in findings:
        assert finding.level == "ok" or finding.remedy, finding.what
        assert "\n" not in finding.what + finding.remedy


def test_exit_code_is_1_when_something_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    looks = "tools.doctor.examination.examine"
    monkeypatch.setattr(looks, lambda endpoint: iter([Finding("fail", "the roof", "mend it")]))
    assert app.execute(["doctor"]) == 1
    assert capsys.readouterr().out == "fail  the roof: mend it\n"
    monkeypatch.setattr(looks, lambda endpoint: iter([Finding("warn", "the roof", "mend it")]))
    assert app.execute(["doctor"]) == 0


# --- software ---------------------------------------------------------------------------------------------------


def test_old_python_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    assert software.python().level == "ok"
    monkeypatch.setattr(sys, "version_info", (3, 10, 4))
    not_well(software.python(), "install Python 3.11", level="fail")


def test_package_of_another_version_than_was_tested_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    versions = {"eclipse-zenoh": "1.10.2", "Typer_X": "0.30"}
    needed = ["eclipse-zenoh>=1.10,<2", "Typer_X>=0.2", "ruff; extra == 'dev'"]
    monkeypatch.setattr(software, "requires", lambda name: needed)
    monkeypatch.setattr(software, "version", versions.__getitem__)
    monkeypatch.setattr(software, "CONSTRAINTS", tmp_path / "constraints.txt")
    (finding,) = software.packages()  # no file of versions: an image
    assert finding == Finding("ok", "packages: eclipse-zenoh 1.10.2, Typer_X 0.30")
    (tmp_path / "constraints.txt").write_text("# tested\neclipse_zenoh==1.10.2\ntyper-x==0.29\n")
    (finding,) = software.packages()
    not_well(finding, "Typer_X 0.30 (tested: 0.29)", "pip install -c constraints.txt")
    assert "zenoh" not in finding.what


def test_missing_package_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        raise software.PackageNotFoundError(name)

    monkeypatch.setattr(software, "requires", lambda name: ["viser>=1"])
    monkeypatch.setattr(software, "version", version)
    not_well(next(software.packages()), "package viser is missing", "make setup", level="fail")


def test_project_that_is_not_installed_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    def requires(name: str) -> list[str]:
        raise software.PackageNotFoundError(name)

    monkeypatch.setattr(software, "requires", requires)
    (finding,) = software.packages()
    not_well(finding, "not installed", "pip install")


def test_what_is_installed_on_demand_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = ["numpy>=1", 'mujoco<4,>=3; extra == "physics"', 'ur-rtde>=1; extra == "ur"', 'ruff; extra == "dev"']

    def version(name: str) -> str:
        if name == "ur-rtde":
            raise software.PackageNotFoundError(name)
        return "3.2"

    monkeypatch.setattr(software, "requires", lambda name: wanted)
    monkeypatch.setattr(software, "version", version)
    assert software.extras().what == "extras: mujoco 3.2 (physics)"
    monkeypatch.setattr(software, "requires", lambda name: [])
    assert software.extras().what == "extras: none"


def test_planning_kernel_that_is_not_compiled_is_named(monkeypatch):
    monkeypatch.setattr(software, "library_path", lambda: software.Path("planning_kernel_avx2.so"))
    assert software.kernel().level == "ok" and "planning_kernel_avx2.so" in software.kernel().what
    monkeypatch.setattr(software, "library_path", lambda: None)
    not_well(software.kernel(), software.INSTALL)


# --- configuration ----------------------------------------------------------------------------------------------


def test_missing_description_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "it.yaml").write_text(
        "{name: it, urdf: nowhere.urdf, joints: [a], base_link: b, tcp_link: t, named_poses: {home: [0]},"
        " acceleration_limits: [1], jerk_limits: [1]}"
    )
    (tmp_path / "robots" / "wrong.yaml").write_text("{name: wrong}")
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path))
    it, wrong = examination.robots()
    not_well(it, "robot it: nowhere.urdf is missing", "pip install", level="fail")
    not_well(wrong, "robot wrong: urdf: is missing", "correct", "wrong.yaml", level="fail")


def test_robots_and_cells_that_come_with_us_are_well() -> None:
    assert [(finding.level, finding.what.split(":")[0]) for finding in examination.robots()] == [
        ("ok", "robot fr3"), ("ok", "robot panda"), ("ok", "robot ur5")]
    assert [(finding.level, finding.what.split(":")[0]) for finding in examination.cells()] == [
        ("ok", "cell panda"), ("ok", "cell ur5")]


@pytest.mark.parametrize(("text", "parts"), [
    ("robot: [1,", ["does not parse"]),
    ("{robot: panda, world: balls, pipeline: cartesian_ompl, task: a, services: {nobody: {}}}", ["nobody", "choices"]),
    ("{robot: panda, world: balls, pipeline: cartesian_ompl, task: a, services: {my.own: {}}}", ["my.own", "module"]),
    ("{robot: panda, world: balls, pipeline: cartesian_ompl, task: a, services: {robot_state_publisher: {rate: 0}}}",
     ["services.robot_state_publisher.rate", "0"]),
])
def test_cell_that_can_not_be_used_fails(
    text: str, parts: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "config"
    shutil.copytree(examination.Path(__file__).resolve().parents[2] / "config", root)
    for path in (root / "cells").iterdir():
        path.unlink()
    (root / "cells" / "mine.yaml").write_text(text)
    monkeypatch.setenv("ZENCELL_CONFIG", str(root))
    monkeypatch.setattr(sys, "path", list(sys.path))
    (finding,) = examination.cells()
    not_well(finding, "cell mine", *parts, str(root / "cells" / "mine.yaml"), level="fail")


def test_configuration_that_is_not_there_or_empty_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path / "nowhere"))
    (finding,) = examination.cells()
    not_well(finding, "nowhere", "(ZENCELL_CONFIG)", "unset", level="fail")
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path))
    (finding,) = examination.cells()
    not_well(finding, "no cell in", level="fail")


def test_service_that_can_not_be_imported_fails(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "fakes" / "middle.py").write_text("import nothing_of_that_name\n")
    (folder / "cells").mkdir()
    (folder / "tiny.yaml").rename(folder / "cells" / "tiny.yaml")
    for kind in ("robots", "worlds", "pipelines"):
        shutil.copytree(Path(__file__).resolve().parents[2] / "config" / kind, folder / kind)
    monkeypatch.setenv("ZENCELL_CONFIG", str(folder))
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (finding,) = examination.cells()
    not_well(finding, "cell tiny", "nothing_of_that_name", "install what is missing", level="fail")


# --- network ----------------------------------------------------------------------------------------------------


def test_port_that_something_else_holds_is_a_warning(listener: int, monkeypatch: pytest.MonkeyPatch) -> None:
    not_well(network.router(f"tcp/127.0.0.1:{listener}"), "in use by process", "--domain")
    assert network.router(NOWHERE).level == "ok"
    monkeypatch.setattr(network, "PAGE_PORT", listener)
    not_well(network.page(), f"port {listener}", "in use by process", "--viewer-port")
    monkeypatch.setattr(network, "PAGE_PORT", 1)
    assert network.page().level == "ok"


def test_router_that_can_not_be_reached_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> socket.socket:
        raise TimeoutError("timed out")

    monkeypatch.setattr(socket, "create_connection", refuse)
    not_well(network.router("tcp/192.0.2.1:7447"), "cannot be reached", "--connect")


def test_cell_that_speaks_another_version_fails(listener: int, monkeypatch: pytest.MonkeyPatch) -> None:
    async def problems(endpoint: str) -> dict[str, str]:
        return {"old": str(DecodeError("attachment: schema version 1, this side has 2")), "new": ""}

    monkeypatch.setattr(network, "schema_problems", problems)
    monkeypatch.setattr(network, "service_commands", lambda: {7: ["/other/bin/python", *SERVICE[1:]], 8: [*SERVICE]})
    new, old, foreign = network.versions(f"tcp/127.0.0.1:{listener}")
    assert new.level == "ok"
    not_well(old, "cell old", "schema version 1, this side has 2", "same version", level="fail")
    not_well(foreign, "7 (/other/bin/python)", "environment")
    assert "8" not in foreign.what
    assert list(network.versions(NOWHERE)) == []


async def test_version_is_read_from_what_the_supervisor_says(monkeypatch: pytest.MonkeyPatch) -> None:
    from contextlib import asynccontextmanager

    from common import topics
    from common.messages import SupervisorStatus
    from common.transport.codec import Attachment, encode, encode_attachment

    here = LocalNetwork()

    @asynccontextmanager
    async def connect(**_: Any) -> Any:
        yield here.bus("tool", cell="_")

    monkeypatch.setattr("common.transport.zenoh_session.connect", connect)
    good = here.bus("supervisor", cell="good")
    good.writer(topics.SUPERVISOR_STATUS).put(SupervisorStatus(cell="good", services=[]))
    await good.ready()
    await here.bus("supervisor", cell="other").ready()
    payload = encode(SupervisorStatus(cell="other", services=[]))
    attachment = encode_attachment(Attachment("supervisor.1", 1, schema=99))

    def answer(query: Any) -> None:
        query.reply("other/supervisor/status", payload, "", attachment)
        query.finish()

    here.session().queryable("other/supervisor/status", answer, complete=False)
    found = await network.schema_problems(NOWHERE)
    assert found["good"] == ""
    assert "schema version 99" in found["other"]


# --- leftovers --------------------------------------------------------------------------------------------------


def seen(pid: int, ppid: int, command: tuple[str, ...], status: str = "sleeping", age: float = 100.0,
         name: str = "python") -> Process:
    return Process(pid, ppid, name, status, age, command)


def test_cell_that_is_up_is_no_leftover() -> None:
    findings = list(process_findings([seen(1, 0, ("init",)), seen(10, 1, RUNNING, age=7300), seen(11, 10, SERVICE)]))
    assert [finding.level for finding in findings] == ["ok", "ok"]
    assert findings[0].what == "a cell runs or starts: zencell up panda (10), for 2 h"


@pytest.mark.parametrize("parent", [seen(1, 0, ("/sbin/init",)), seen(5, 1, ("/usr/bin/tini",), name="tini")])
def test_service_whose_supervisor_was_killed_is_to_be_killed(parent: Process) -> None:
    (finding,) = process_findings([parent, seen(11, parent.pid, SERVICE, "stopped"), seen(12, parent.pid, SERVICE)])
    not_well(finding, "without a supervisor: vision_detector (11), vision_detector (12)", "kill -9 11 12")


def test_service_of_a_parent_that_can_not_be_seen_is_without_a_supervisor() -> None:
    (finding,) = process_findings([seen(11, 10, SERVICE)])
    not_well(finding, "kill -9 11")


def test_stopped_service_of_a_living_cell_can_go_on() -> None:
    finding, up = process_findings([seen(10, 1, RUNNING), seen(11, 10, SERVICE, "stopped"), seen(12, 10, SERVICE)])
    not_well(finding, "stopped (SIGSTOP): vision_detector (11)", "kill -CONT 11")
    assert up.level == "ok"


def test_stopped_supervisor_can_go_on_or_be_ended() -> None:
    (finding,) = process_findings([seen(10, 1, RUNNING, "stopped"), seen(11, 10, SERVICE)])
    not_well(finding, "a supervisor is stopped", "zencell up panda (10)", "kill -CONT 10", "kill -9 10")


def test_old_supervisor_without_services_is_to_be_ended() -> None:
    (finding,) = process_findings([seen(10, 1, RUNNING)])
    not_well(finding, "a supervisor without services", "kill 10")
    assert [f.level for f in process_findings([seen(10, 1, RUNNING, age=2.0)])] == ["ok", "ok"]  # it has just begun


def test_other_programs_are_none_of_our_business() -> None:
    others = [seen(2, 1, ("vim", "zencell.txt")), seen(3, 1, ("python", "-m", "services")), seen(4, 1, ()),
              seen(5, 1, (sys.executable, "zencell", "topic", "echo", "tf"))]
    assert list(process_findings(others)) == [Finding("ok", "no process is left from an earlier run")]


@pytest.mark.slow
def test_stopped_service_of_a_cell_is_found_until_the_cell_is_gone(zencell: Callable[..., Zencell]) -> None:
    command = zencell("up", "tiny.yaml")
    command.until("zenoh --mode client")
    middle = command.children()["middle"]
    middle.suspend()
    while middle.status() != psutil.STATUS_STOPPED:  # only its parent is told when that is so, up to 5 ms later
        time.sleep(0.001)
    (found,) = (f for f in machine.processes() if f"middle ({middle.pid})" in f.what)
    not_well(found, "stopped (SIGSTOP)", "kill -CONT", str(middle.pid))
    command.process.kill()
    command.end()
    command.until_childless()  # the system wakes it when its supervisor dies
    assert not [f for f in machine.processes() if f"({middle.pid})" in f.what]


def test_service_that_outlived_its_supervisor_is_found() -> None:
    waits = "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
    deaf = [sys.executable, "-c", waits, "-m", "services.deaf", "--gate"]
    shell = subprocess.Popen(["sh", "-c", f"{shlex.join(deaf)} &"], stdout=subprocess.PIPE, text=True)
    with shell:
        assert shell.stdout is not None
        process = psutil.Process(int(shell.stdout.readline()))
        shell.wait()  # now somebody else is its parent
        try:
            (found,) = (f for f in machine.processes() if f"deaf ({process.pid})" in f.what)
        finally:
            process.kill()
    not_well(found, "without a supervisor", "kill -9", str(process.pid))


# --- machine ----------------------------------------------------------------------------------------------------


def test_little_shared_memory_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Disk(1, 1, 10e6))
    not_well(machine.shared_memory(), "/dev/shm has 10 MB left", "--shm-size")


def test_little_memory_is_a_warning_also_within_a_container(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(environment, "CONTROL_GROUP", tmp_path)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: namedtuple("M", "available")(8e9))
    assert machine.memory().level == "ok"
    (tmp_path / "memory.max").write_text("2000000000\n")
    (tmp_path / "memory.current").write_text("1600000000\n")
    not_well(machine.memory(), "0.4 GB of memory left within the limit of this container", "raise the limit")
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.memory().level == "ok"
    monkeypatch.setattr(psutil, "virtual_memory", lambda: namedtuple("M", "available")(0.5e9))
    not_well(machine.memory(), "0.5 GB of memory left", "a cell needs 1 GB")


def test_few_or_busy_processors_are_a_warning(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(environment, "CONTROL_GROUP", tmp_path)
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0, 1, 2, 3}, raising=False)
    monkeypatch.setattr(psutil, "cpu_percent", lambda interval: 10.0)
    assert machine.cores().level == "ok"
    monkeypatch.setattr(psutil, "cpu_percent", lambda interval: 95.0)
    not_well(machine.cores(), "0.2 of them free", "0.7 of a core")
    monkeypatch.setattr(psutil, "cpu_percent", lambda interval: 0.0)
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    not_well(machine.cores(), "1.5 cores", "two cores", "--speed")


def test_little_disk_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Disk(1, 1, 1e9))
    not_well(machine.disk(), "1.0 GB of disk left", "GB a minute")


def test_few_open_files_are_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (64, 1024))
    not_well(machine.open_files(), "64 files", "ulimit -n 1024")
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert machine.open_files().level == "ok"


def test_clock_that_is_not_set_or_coarse_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(time, "gmtime", lambda: time.struct_time((1970, 1, 1, 0, 0, 0, 3, 1, 0)))
        not_well(machine.clock(), "1970", "timedatectl")
    with monkeypatch.context() as patch:
        patch.setattr(time, "get_clock_info", lambda name: namedtuple("C", "resolution")(0.016))
        not_well(machine.clock(), "ticks every 16 ms", "kernel")
    assert machine.clock().level == "ok"


def test_container_engine_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert machine.container_engine().level == "ok"
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    assert machine.container_engine().what == "docker and podman for the image"
