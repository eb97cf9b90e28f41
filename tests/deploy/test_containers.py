"""The Panda in containers, for real: built, brought up, seen from the host, hurt, and taken down."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from common.config import load_cell
from deploy.generate import ROOT

pytestmark = [pytest.mark.container, pytest.mark.timeout(900)]

PROJECT = "zencell-test"
MOST_MEGABYTES = 900
PAGE_PORT = "18080"
SERVICES = ["router", *(f"panda-{entry.name}" for entry in load_cell("panda").services.values())]


def run(*command: str, timeout: float = 60, check: bool = True) -> str:
    environment = {**os.environ, "ZENCELL_PAGE": PAGE_PORT}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=timeout, check=False
    )
    assert done.returncode == 0 or not check, f"{' '.join(command)}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


def compose(*arguments: str, timeout: float = 60) -> str:
    return run("docker", "compose", "-p", PROJECT, *arguments, timeout=timeout)


def inspect(service: str) -> dict[str, Any]:
    container = compose("ps", "-a", "-q", service).strip()
    found: list[dict[str, Any]] = json.loads(run("docker", "inspect", container))
    return found[0]


def wait_for(what: str, seen: Any, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while not seen():
        assert time.monotonic() < deadline, f"{what}: not within {seconds:g} s\n{compose('logs', '--tail', '3')}"
        time.sleep(0.5)


@pytest.fixture(scope="module")
def cell() -> Iterator[None]:
    answers = shutil.which("docker") and subprocess.run(["docker", "info"], capture_output=True, check=False)
    if not answers or answers.returncode:
        pytest.skip("no container engine answers `docker info`")
    compose("build", timeout=800)
    try:
        compose("up", "-d", "--no-build", timeout=180)
        yield
    finally:
        # Old engines can keep the network of a container that was started again: what counts is that none is left.
        run("docker", "compose", "-p", PROJECT, "down", "-v", "-t", "10", timeout=120, check=False)
    assert compose("ps", "-a", "-q") == ""


def status_on_host() -> dict[str, Any]:
    """The task's status, as zenoh-cli on the host reads it."""
    networks = inspect("router")["NetworkSettings"]["Networks"]
    [address] = [network["IPAddress"] for network in networks.values()]
    line = run(
        str(Path(sys.executable).with_name("zenoh")), "--mode", "client", "--connect", f"tcp/{address}:7447", "get",
        "-s", "panda/pick_place_status", "--decoder", "msgpack", "--line", "{value}", check=False,
    ).strip()
    return json.loads(line) if line else {}


def test_plain_up_clears_the_table_as_the_host_sees_it(cell: None) -> None:
    wait_for("task is DONE", lambda: status_on_host().get("state") == "DONE", 240)
    assert status_on_host()["placed"] == 7


@pytest.mark.parametrize("service", SERVICES)
def test_every_container_is_healthy_and_has_no_rights(cell: None, service: str) -> None:
    wait_for(f"{service} is healthy", lambda: inspect(service)["State"]["Health"]["Status"] == "healthy", 60)
    found = inspect(service)
    assert found["HostConfig"]["ReadonlyRootfs"]
    assert compose("exec", "-T", service, "id", "-u").strip() != "0"


def test_only_the_page_is_published_and_only_to_this_machine(cell: None) -> None:
    published = {
        (service, port["HostIp"], port["HostPort"])
        for service in SERVICES
        for ports in inspect(service)["NetworkSettings"]["Ports"].values() for port in ports or ()
    }
    assert published == {("panda-viewer", "127.0.0.1", PAGE_PORT)}


def test_image_is_small_and_has_no_tools_to_build_with(cell: None) -> None:
    size = int(run("docker", "image", "inspect", "-f", "{{.Size}}", "zencell"))
    assert size < MOST_MEGABYTES * 1e6
    missing = compose("exec", "-T", "router", "sh", "-c", "command -v gcc cc make pip; true").strip()
    assert missing.replace("/usr/local/bin/pip", "") == ""
    robots = compose("exec", "-T", "router", "sh", "-c", "ls $(python -c 'import pathlib, cmeel; print(pathlib.Path("
                     "cmeel.__file__).parents[1])')/cmeel.prefix/share/example-robot-data/robots").split()
    assert sorted(robots) == ["panda_description", "ur_description"]


def test_configuration_can_not_be_changed_from_inside(cell: None) -> None:
    said = compose("exec", "-T", "router", "sh", "-c", "(echo x >> /app/config/cells/panda.yaml) 2>&1; true")
    assert "Read-only" in said or "denied" in said


def test_service_that_is_killed_is_started_again(cell: None) -> None:
    before = inspect("panda-vision_detector")
    os.kill(before["State"]["Pid"], signal.SIGKILL)
    wait_for(
        "vision_detector is back",
        lambda: (now := inspect("panda-vision_detector")["State"])["Pid"] not in (0, before["State"]["Pid"])
        and now["Health"]["Status"] == "healthy", 60,
    )
