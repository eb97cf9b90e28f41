"""The Panda in containers, for real: built, brought up, seen from the host, hurt, and taken down."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from common.config import load_cell
from tests.deploy.engine import Containers, require_engine, run

pytestmark = [pytest.mark.container, pytest.mark.timeout(900)]

MOST_MEGABYTES = 900
PAGE_PORT = "18080"
SERVICES = ["router", *(f"panda-{entry.name}" for entry in load_cell("panda").services.values())]


@pytest.fixture(scope="module")
def cell() -> Iterator[Containers]:
    require_engine()
    with Containers("zencell-test", environment={"ZENCELL_PAGE": PAGE_PORT}) as containers:
        containers.compose("build", timeout=800)
        containers.compose("up", "-d", "--no-build", timeout=180)
        yield containers


def status_on_host(cell: Containers) -> dict[str, Any]:
    """The task's status, as zenoh-cli on the host reads it."""
    line = run(
        str(Path(sys.executable).with_name("zenoh")), "--mode", "client",
        "--connect", f"tcp/{cell.address('router')}:7447", "get",
        "-s", "panda/pick_place_status", "--decoder", "msgpack", "--line", "{value}", check=False,
    ).strip()
    return json.loads(line) if line else {}


def test_plain_up_clears_the_table_as_the_host_sees_it(cell: Containers) -> None:
    cell.wait_for("task is DONE", lambda: status_on_host(cell).get("state") == "DONE", 240)
    assert status_on_host(cell)["placed"] == 7


@pytest.mark.parametrize("service", SERVICES)
def test_every_container_is_healthy_and_has_no_rights(cell: Containers, service: str) -> None:
    cell.wait_for(f"{service} is healthy", lambda: cell.health(service) == "healthy", 60)
    found = cell.inspect(service)
    assert found["HostConfig"]["ReadonlyRootfs"]
    assert cell.compose("exec", "-T", service, "id", "-u").strip() != "0"


def test_only_the_page_is_published_and_only_to_this_machine(cell: Containers) -> None:
    published = {
        (service, port["HostIp"], port["HostPort"])
        for service in SERVICES
        for ports in cell.inspect(service)["NetworkSettings"]["Ports"].values() for port in ports or ()
    }
    assert published == {("panda-viewer", "127.0.0.1", PAGE_PORT)}


def test_image_is_small_and_has_no_tools_to_build_with(cell: Containers) -> None:
    size = int(run("docker", "image", "inspect", "-f", "{{.Size}}", "zencell"))
    assert size < MOST_MEGABYTES * 1e6
    missing = cell.compose("exec", "-T", "router", "sh", "-c", "command -v gcc cc make pip zig; true").strip()
    assert missing.replace("/usr/local/bin/pip", "") == ""
    robots = cell.compose(
        "exec", "-T", "router", "sh", "-c", "ls $(python -c 'import pathlib, cmeel; print(pathlib.Path("
        "cmeel.__file__).parents[1])')/cmeel.prefix/share/example-robot-data/robots",
    ).split()
    assert sorted(robots) == ["panda_description", "ur_description"]


def test_planning_kernel_is_in_the_image_and_what_compiled_it_is_not(cell: Containers) -> None:
    assert "ok    planning kernel: planning_kernel" in cell.compose("exec", "-T", "router", "zencell", "doctor")
    packages = cell.compose("exec", "-T", "router", "sh", "-c", "ls /opt/zencell/lib/python3*/site-packages")
    assert "pydantic" in packages and "ziglang" not in packages


def test_configuration_can_not_be_changed_from_inside(cell: Containers) -> None:
    said = cell.compose("exec", "-T", "router", "sh", "-c", "(echo x >> /app/config/cells/panda.yaml) 2>&1; true")
    assert "Read-only" in said or "denied" in said


def test_service_that_is_killed_is_started_again(cell: Containers) -> None:
    before = cell.inspect("panda-vision_detector")
    os.kill(before["State"]["Pid"], signal.SIGKILL)
    cell.wait_for(
        "vision_detector is back",
        lambda: (now := cell.inspect("panda-vision_detector")["State"])["Pid"] not in (0, before["State"]["Pid"])
        and now["Health"]["Status"] == "healthy", 60,
    )


def said(cell: Containers, *arguments: str) -> str:
    """What a zencell command says that is run in the router's container."""
    return cell.compose("exec", "-T", "router", "zencell", *arguments, "--cell", "panda", timeout=120)


def heard(cell: Containers, key: str) -> dict[str, Any]:
    """The next message of a topic."""
    message: dict[str, Any] = json.loads(said(cell, "topic", "echo", key, "--count", "1", "--json"))
    return message


def test_what_a_person_stopped_stays_so_when_containers_are_started_again_or_made_anew(cell: Containers) -> None:
    executor, task = "panda-trajectory_executor", "panda-smart_pick_place"
    patience = 240.0  # [s] only ever waited for by a test that fails

    def rests() -> tuple[list[float], dict[str, Any]]:
        """Where the arm is, and who stopped it, once the task that was started again has said that it waits."""
        cell.wait_for("the task waits", lambda: heard(cell, "pick_place_status")["message"].startswith("stopped since"),
                      patience)
        (stop,) = heard(cell, "motion/status")["interlocks"]
        return heard(cell, "joint_states")["position"], stop

    cell.wait_for("the task is ready", lambda: cell.is_ready(task), patience)
    if heard(cell, "pick_place_status")["state"] == "DONE":
        said(cell, "world", "reset")
    said(cell, "task", "start")
    cell.wait_for("the arm moves", lambda: heard(cell, "motion/status")["state"] == "active", patience)
    said(cell, "task", "stop")
    cell.wait_for("the arm is at rest", lambda: heard(cell, "motion/status")["state"] != "active", patience)
    where, stop = rests()
    assert stop["kind"] == "stopped" and "@" in stop["by"]

    before = {service: cell.inspect(service)["State"]["Pid"] for service in (executor, task)}
    for pid in before.values():
        os.kill(pid, signal.SIGKILL)
    for service, pid in before.items():
        cell.wait_for(f"{service} is back", lambda service=service, pid=pid: (  # type: ignore[misc]
            cell.inspect(service)["State"]["Pid"] not in (0, pid) and cell.is_ready(service)), patience)
    assert rests() == (where, stop)

    cell.compose("down", "-t", "10", timeout=180)  # the volume stays
    cell.compose("up", "-d", "--no-build", timeout=180)
    for service in (executor, task):  # what is simulated begins anew with new containers
        cell.wait_for(f"{service} is ready", lambda service=service: cell.is_ready(service), patience)  # type: ignore[misc]
        where = heard(cell, "joint_states")["position"] if service == executor else where
    assert rests() == (where, stop)

    said(cell, "task", "start")
    cell.wait_for("the arm moves", lambda: heard(cell, "joint_states")["position"] != where, patience)
    assert heard(cell, "motion/status")["interlocks"] == []
