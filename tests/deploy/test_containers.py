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
