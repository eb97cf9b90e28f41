"""`zencell doctor`: findings about this machine, each with a remedy unless it is well."""

import resource
import shlex
import shutil
import socket
import subprocess
import sys
import time
from collections import namedtuple
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import psutil
import pytest

from cli.main import app
from common import topics
from common.errors import DecodeError
from common.messages import SupervisorStatus
from common.process import environment
from common.transport.codec import Attachment, encode, encode_attachment
from common.transport.local import LocalNetwork
from tests.harness import ROOT
from tools.doctor import Finding, examination, machine, network
from tools.doctor import examination as software
from tools.doctor.examination import examine
from tools.doctor.machine import Process, process_findings

Disk = namedtuple("Disk", "total used free")
NOWHERE = "tcp/127.0.0.1:1"
SERVICE = (sys.executable, "-P", "-m", "services.vision_detector", "--cell", "panda", "--domain", "42", "--gate")
RUNNING = (sys.executable, "/usr/bin/zencell", "up", "panda")


@pytest.fixture
def listener():
    """A port on which another program listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def check(finding: Finding, *parts: str, level: str = "warn") -> None:
    """Check that a finding has a remedy and all of the parts."""
    assert finding.level == level and finding.remedy
    text = f"{finding.what}: {finding.remedy}"
    assert all(part in text for part in parts), text


def test_findings_about_this_machine_are_lines_with_remedies():
    findings = list(examine(NOWHERE))
    assert len(findings) > 12
    for finding in findings:
        assert finding.level == "ok" or finding.remedy, finding.what
        assert "\n" not in finding.what + finding.remedy


@pytest.mark.parametrize(("level", "code"), [("fail", 1), ("warn", 0)])
def test_exit_code_is_1_after_a_failed_check(level, code, monkeypatch, capsys):
    monkeypatch.setattr(examination, "examine", lambda endpoint: iter([Finding(level, "the roof", "mend it")]))
    assert app.execute(["doctor"]) == code
    assert capsys.readouterr().out == f"{level}  the roof: mend it\n"


# --- software ---------------------------------------------------------------------------------------------------


def install(monkeypatch: pytest.MonkeyPatch, needed: list[str] | None, versions: dict[str, str]) -> None:
    """Have packages installed; needed are those of the project, or None if it is not installed itself."""
    def requires(name: str) -> list[str]:
        if needed is None:
            raise software.PackageNotFoundError(name)
        return needed

    def version(name: str) -> str:
        if name not in versions:
            raise software.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(software, "requires", requires)
    monkeypatch.setattr(software, "version", version)


def test_packages_are_compared_with_the_tested_versions(monkeypatch, tmp_path):
    install(monkeypatch, ["eclipse-zenoh>=1.10,<2", "Typer_X>=0.2", "ruff; extra == 'dev'"],
            {"eclipse-zenoh": "1.10.2", "Typer_X": "0.30"})
    monkeypatch.setattr(software, "CONSTRAINTS", tmp_path / "constraints.txt")
    (finding,) = software.packages()  # an image has no file of versions
    assert finding == Finding("ok", "packages: eclipse-zenoh 1.10.2, Typer_X 0.30")
    (tmp_path / "constraints.txt").write_text("# tested\neclipse_zenoh==1.10.2\ntyper-x==0.29\n")
    (finding,) = software.packages()
    check(finding, "Typer_X 0.30 (tested: 0.29)", "pip install -c constraints.txt")
    assert "zenoh" not in finding.what
    install(monkeypatch, ["viser>=1"], {})
    check(next(software.packages()), "package viser is missing", "make setup", level="fail")
    install(monkeypatch, None, {})
    (finding,) = software.packages()
    check(finding, "not installed", "pip install")


def test_extras_are_named(monkeypatch):
    needed = ["numpy>=1", 'mujoco<4,>=3; extra == "physics"', 'ur-rtde>=1; extra == "ur"', 'ruff; extra == "dev"']
    install(monkeypatch, needed, {"numpy": "3.2", "mujoco": "3.2", "ruff": "3.2"})
    assert software.extras().what == "extras: mujoco 3.2 (physics)"
    install(monkeypatch, [], {})
    assert software.extras().what == "extras: none"


# --- configuration ----------------------------------------------------------------------------------------------


def test_robots_and_cells_of_the_project_are_well():
    found = [(finding.level, finding.what.split(":")[0]) for finding in (*examination.robots(), *examination.cells())]
    names = {"robot": ("fr3", "panda", "ur5", "ur5_cup"), "cell": (
        "conveyor", "duo", "handover", "insertion", "panda", "policy_panda", "sorting", "sorting_ur5",
        "tending", "ur5")}
    assert found == [("ok", f"{kind} {name}") for kind in names for name in names[kind]]


def test_incomplete_robot_and_missing_description_fail(tmp_path, monkeypatch):
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "it.yaml").write_text(
        "{name: it, urdf: nowhere.urdf, joints: [a], base_link: b, tcp_link: t, named_poses: {home: [0]},"
        " acceleration_limits: [1], jerk_limits: [1]}")
    (tmp_path / "robots" / "wrong.yaml").write_text("{name: wrong}")
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path))
    it, wrong = examination.robots()
    check(it, "robot it: nowhere.urdf is missing", "pip install", level="fail")
    check(wrong, "robot wrong: urdf: is missing", "correct", "wrong.yaml", level="fail")


@pytest.mark.parametrize(("services", "parts"), [
    (None, ["does not parse"]), ("no_such: {}", ["no_such", "choices"]), ("my.own: {}", ["my.own", "module"]),
    ("robot_state_publisher: {rate: 0}", ["services.robot_state_publisher.rate", "0"]),
    ("of_mine.task: {}", ["nothing_of_that_name", "install what is missing"]),
])
def test_unusable_cell_fails(services, parts, tmp_path, monkeypatch):
    shutil.copytree(ROOT / "config", tmp_path / "config", ignore=shutil.ignore_patterns("cells"))
    file = tmp_path / "config" / "cells" / "mine.yaml"
    file.parent.mkdir()
    file.write_text("robot: [1," if services is None else
                    f"{{robot: panda, world: balls, pipeline: cartesian_ompl, task: a, services: {{{services}}}}}")
    (tmp_path / "of_mine").mkdir()
    (tmp_path / "of_mine" / "task.py").write_text("import nothing_of_that_name\n")
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path)
    (finding,) = examination.cells()
    check(finding, "cell mine", *parts, level="fail")


def test_missing_or_empty_configuration_fails(tmp_path, monkeypatch):
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path / "nowhere"))
    (finding,) = examination.cells()
    check(finding, "nowhere", "(ZENCELL_CONFIG)", "unset", level="fail")
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path))
    (finding,) = examination.cells()
    check(finding, "no cell in", level="fail")


# --- network ----------------------------------------------------------------------------------------------------


def test_port_of_another_program_and_an_unreachable_router_are_warnings(listener, monkeypatch):
    check(network.router(f"tcp/127.0.0.1:{listener}"), "in use by process", "--domain")
    assert network.router(NOWHERE).level == "ok"
    monkeypatch.setattr(network, "PAGE_PORT", listener)
    check(network.page(), f"port {listener}", "in use by process", "--viewer-port")
    monkeypatch.setattr(network, "PAGE_PORT", 1)
    assert network.page().level == "ok"
    monkeypatch.setattr(socket, "create_connection", Mock(side_effect=TimeoutError("timed out")))
    check(network.router("tcp/192.0.2.1:7447"), "cannot be reached", "--connect")


def test_cell_with_another_message_version_fails(listener, monkeypatch):
    async def problems(endpoint: str) -> dict[str, str]:
        return {"old": str(DecodeError("attachment: schema version 1, this side has 2")), "new": ""}

    monkeypatch.setattr(network, "schema_problems", problems)
    monkeypatch.setattr(network, "service_commands", lambda: {7: ["/other/bin/python", *SERVICE[1:]], 8: [*SERVICE]})
    new, old, foreign = network.versions(f"tcp/127.0.0.1:{listener}")
    assert new.level == "ok"
    check(old, "cell old", "schema version 1, this side has 2", "same version", level="fail")
    check(foreign, "7 (/other/bin/python)", "environment")
    assert "8" not in foreign.what
    assert list(network.versions(NOWHERE)) == []


async def test_version_is_read_from_the_supervisors_status(monkeypatch):
    here = LocalNetwork()

    @asynccontextmanager
    async def connect(**_: Any) -> Any:
        yield here.bus("tool", cell="_")

    monkeypatch.setattr("common.transport.zenoh_session.connect", connect)
    good = here.bus("supervisor", cell="good")
    good.writer(topics.SUPERVISOR_STATUS).put(SupervisorStatus(cell="good", services=[]))
    await good.ready()
    await here.bus("supervisor", cell="other").ready()

    def answer(query: Any) -> None:
        attachment = encode_attachment(Attachment("supervisor.1", 1, schema=99))
        query.reply("other/supervisor/status", encode(SupervisorStatus(cell="other", services=[])), "", attachment)
        query.finish()

    here.session().queryable("other/supervisor/status", answer, complete=False)
    found = await network.schema_problems(NOWHERE)
    assert found["good"] == "" and "schema version 99" in found["other"]


# --- processes --------------------------------------------------------------------------------------------------


def process(pid: int, ppid: int, command: tuple[str, ...], status: str = "sleeping", age: float = 100.0,
            name: str = "python") -> Process:
    return Process(pid, ppid, name, status, age, command)


INIT, TINI = process(1, 0, ("/sbin/init",)), process(5, 1, ("/usr/bin/tini",), name="tini")
CELL, STOPPED_CELL = process(10, 1, RUNNING), process(10, 1, RUNNING, "stopped")
ORPHANS = ["without a supervisor: vision_detector (11), vision_detector (12)", "kill -9 11 12"]


@pytest.mark.parametrize(("processes", "parts"), [
    ([INIT, process(11, 1, SERVICE, "stopped"), process(12, 1, SERVICE)], ORPHANS),
    ([TINI, process(11, 5, SERVICE, "stopped"), process(12, 5, SERVICE)], ORPHANS),
    ([process(11, 10, SERVICE)], ["kill -9 11"]),  # its parent is invisible
    ([CELL, process(11, 10, SERVICE, "stopped"), process(12, 10, SERVICE)],
     ["stopped (SIGSTOP): vision_detector (11)", "kill -CONT 11"]),
    ([STOPPED_CELL, process(11, 10, SERVICE)],
     ["a supervisor is stopped", "zencell up panda (10)", "kill -CONT 10", "kill -9 10"]),
    ([CELL], ["a supervisor without services", "kill 10"]),
], ids=["of init", "of a container's init", "of an invisible parent", "stopped", "stopped supervisor", "alone"])
def test_orphans_and_stopped_processes_are_warnings_with_a_command(processes, parts):
    finding, *others = process_findings(processes)
    check(finding, *parts)
    assert all(other.level == "ok" for other in others)


def test_running_cell_and_other_programs_are_no_leftovers():
    cell, left = process_findings([INIT, process(10, 1, RUNNING, age=7300), process(11, 10, SERVICE)])
    assert (cell.level, left.level) == ("ok", "ok")
    assert cell.what == "a cell runs or starts: zencell up panda (10), for 2 h"
    assert [f.level for f in process_findings([process(10, 1, RUNNING, age=2.0)])] == ["ok", "ok"]  # it just started
    others = [process(2, 1, ("vim", "zencell.txt")), process(3, 1, ("python", "-m", "services")), process(4, 1, ()),
              process(5, 1, (sys.executable, "zencell", "topic", "echo", "tf"))]
    assert list(process_findings(others)) == [Finding("ok", "no process is left from an earlier run")]


def test_service_that_outlived_its_supervisor_is_found():
    waits = "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
    deaf = [sys.executable, "-c", waits, "-m", "services.deaf", "--gate"]
    with subprocess.Popen(["sh", "-c", f"{shlex.join(deaf)} &"], stdout=subprocess.PIPE, text=True) as shell:
        assert shell.stdout is not None
        orphan = psutil.Process(int(shell.stdout.readline()))
        shell.wait()  # now it has another parent
        try:
            (found,) = (f for f in machine.processes() if f"deaf ({orphan.pid})" in f.what)
        finally:
            orphan.kill()
    check(found, "without a supervisor", "kill -9", str(orphan.pid))


# --- machine ----------------------------------------------------------------------------------------------------


@pytest.fixture
def free(monkeypatch, tmp_path):
    """Have enough of everything; change that by paths of functions and their results."""
    def patch(**results):
        for path, result in results.items():
            value = result if path == "sys.version_info" else Mock(return_value=result)
            monkeypatch.setattr(path, value, raising=False)

    monkeypatch.setattr(environment, "CONTROL_GROUP", tmp_path)
    patch(**{"os.sched_getaffinity": {0, 1, 2, 3}, "psutil.cpu_percent": 10.0,
             "psutil.virtual_memory": SimpleNamespace(available=8e9)})
    return patch


@pytest.mark.parametrize(("examined", "results", "level", "parts"), [
    (machine.shared_memory, {"shutil.disk_usage": Disk(1, 1, 10e6)}, "warn", ["/dev/shm has 10 MB left", "--shm-size"]),
    (machine.disk, {"shutil.disk_usage": Disk(1, 1, 1e9)}, "warn", ["1.0 GB of disk left", "GB a minute"]),
    (machine.memory, {}, "ok", []),
    (machine.memory, {"psutil.virtual_memory": SimpleNamespace(available=0.5e9)}, "warn",
     ["0.5 GB of memory left", "a cell needs 1 GB"]),
    (machine.cores, {}, "ok", []),
    (machine.cores, {"psutil.cpu_percent": 95.0}, "warn", ["0.2 of them free", "0.7 of a core"]),
    (machine.open_files, {"resource.getrlimit": (64, 1024)}, "warn", ["64 files", "ulimit -n 1024"]),
    (machine.open_files, {"resource.getrlimit": (resource.RLIM_INFINITY,) * 2}, "ok", []),
    (machine.clock, {"time.gmtime": time.struct_time((1970, 1, 1, 0, 0, 0, 3, 1, 0))}, "warn", ["1970", "timedatectl"]),
    (machine.clock, {"time.get_clock_info": SimpleNamespace(resolution=0.016)}, "warn", ["ticks every 16 ms"]),
    (machine.clock, {}, "ok", []),
    (machine.container_engine, {"shutil.which": None}, "ok", []),
    (machine.container_engine, {"shutil.which": "/usr/bin/it"}, "ok", ["docker and podman for the image"]),
    (software.python, {}, "ok", []),
    (software.python, {"sys.version_info": (3, 10, 4)}, "fail", ["install Python 3.11"]),
    (software.kernel, {"tools.doctor.examination.library_path": Path("planning_kernel_avx2.so")}, "ok",
     ["planning_kernel_avx2.so"]),
    (software.kernel, {"tools.doctor.examination.library_path": None}, "warn", [software.INSTALL]),
])
def test_resources_and_software_are_compared_with_the_needs_of_a_cell(free, examined, results, level, parts):
    free(**results)
    finding = examined()
    assert finding.level == level and (level == "ok" or finding.remedy)
    text = f"{finding.what}: {finding.remedy}"
    assert all(part in text for part in parts), text


def test_limits_of_a_container_apply(free, tmp_path):
    (tmp_path / "memory.max").write_text("2000000000\n")
    (tmp_path / "memory.current").write_text("1600000000\n")
    check(machine.memory(), "0.4 GB of memory left within the limit of this container", "raise the limit")
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.memory().level == "ok"
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    check(machine.cores(), "1.5 cores", "two cores", "--speed")
