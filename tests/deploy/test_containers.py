"""Build the image, run the Panda cell in containers, observe it from the host, kill services, and take it down."""

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from common.config import load_cell
from tests.deploy.engine import Containers, build_image, require_engine, run

pytestmark = [pytest.mark.container, pytest.mark.timeout(900)]

MOST_MEGABYTES = 900
PAGE_PORT = "18080"
SERVICES = ["router", *(f"panda-{entry.name}" for entry in load_cell("panda").services.values())]


@pytest.fixture(scope="module")
def cell():
    require_engine()
    with Containers("zencell-test", environment={"ZENCELL_PAGE": PAGE_PORT}) as containers:
        build_image()
        containers.compose("up", "-d", "--no-build", timeout=180)
        yield containers


def status_on_host(cell: Containers) -> dict[str, Any]:
    """Read the task's status with zenoh-cli on the host."""
    line = run(
        str(Path(sys.executable).with_name("zenoh")), "--mode", "client",
        "--connect", f"tcp/{cell.address('router')}:7447", "get",
        "-s", "panda/pick_place_status", "--decoder", "msgpack", "--line", "{value}", check=False,
    ).strip()
    return json.loads(line) if line else {}


def test_compose_up_clears_the_table(cell):
    cell.wait_for("task is DONE", lambda: status_on_host(cell).get("state") == "DONE", 240)
    assert status_on_host(cell)["placed"] == 7


def test_every_container_is_healthy_and_unprivileged_and_only_the_page_is_published(cell):
    def unhealthy() -> list[str]:
        found = cell.inspect_all()
        return [service for service in SERVICES if found[service]["State"]["Health"]["Status"] != "healthy"]

    cell.wait_for("every service is healthy", lambda: not unhealthy(), 60)
    found = cell.inspect_all()
    assert set(found) == set(SERVICES)
    assert all(each["HostConfig"]["ReadonlyRootfs"] for each in found.values())
    assert not {each["Config"]["User"].partition(":")[0] for each in found.values()} & {"", "0", "root"}
    assert cell.compose("exec", "-T", "router", "id", "-u").strip() != "0"
    published = {
        (service, port["HostIp"], port["HostPort"]) for service, each in found.items()
        for ports in each["NetworkSettings"]["Ports"].values() for port in ports or ()
    }
    assert published == {("panda-viewer", "127.0.0.1", PAGE_PORT)}


def test_image_is_small_and_contains_the_planning_kernel_but_no_build_tools(cell):
    def shell(script: str) -> str:
        return cell.compose("exec", "-T", "router", "sh", "-c", script).strip()

    size = int(run("docker", "image", "inspect", "-f", "{{.Size}}", "zencell"))
    assert size < MOST_MEGABYTES * 1e6
    tools = shell("command -v gcc cc make pip zig; true")
    assert tools.replace("/usr/local/bin/pip", "") == ""
    robots = shell("ls $(python -c 'import pathlib, cmeel; print(pathlib.Path("
                   "cmeel.__file__).parents[1])')/cmeel.prefix/share/example-robot-data/robots")
    assert sorted(robots.split()) == ["panda_description", "ur_description"]
    packages = shell("ls /opt/zencell/lib/python3*/site-packages")
    assert "pydantic" in packages and "ziglang" not in packages
    assert "ok    planning kernel: planning_kernel" in shell("zencell doctor")
    output = shell("(echo x >> /app/config/cells/panda.yaml) 2>&1; true")
    assert "Read-only" in output or "denied" in output, "the configuration is read-only"


def test_killed_service_is_restarted(cell):
    before = cell.inspect("panda-vision_detector")
    os.kill(before["State"]["Pid"], signal.SIGKILL)
    cell.wait_for(
        "vision_detector is back",
        lambda: (now := cell.inspect("panda-vision_detector")["State"])["Pid"] not in (0, before["State"]["Pid"])
        and now["Health"]["Status"] == "healthy", 60,
    )


def zencell(cell: Containers, *arguments: str) -> str:
    """Run a zencell command in the router's container and return its output."""
    return cell.compose("exec", "-T", "router", "zencell", *arguments, "--cell", "panda", timeout=120)


def message_of(cell: Containers, key: str) -> dict[str, Any]:
    """Return the next message of a topic."""
    message: dict[str, Any] = json.loads(zencell(cell, "topic", "echo", key, "--count", "1", "--json"))
    return message


def test_operator_stop_survives_restarted_and_recreated_containers(cell):
    executor, task = "panda-trajectory_executor", "panda-smart_pick_place"
    timeout = 240.0  # [s]

    def stopped_state() -> tuple[list[float], dict[str, Any]]:
        """Wait until the task reports the stop; return the joint positions and the interlock."""
        cell.wait_for("the task waits", lambda: message_of(cell, "pick_place_status")["message"]
                      .startswith("stopped since"), timeout)
        (stop,) = message_of(cell, "motion/status")["interlocks"]
        return message_of(cell, "joint_states")["position"], stop

    cell.wait_for("the task is ready", lambda: cell.is_ready(task), timeout)
    if message_of(cell, "pick_place_status")["state"] == "DONE":
        zencell(cell, "world", "reset")
    zencell(cell, "task", "start")
    cell.wait_for("the arm moves", lambda: message_of(cell, "motion/status")["state"] == "active", timeout)
    zencell(cell, "task", "stop")
    cell.wait_for("the arm is at rest", lambda: message_of(cell, "motion/status")["state"] != "active", timeout)
    position, stop = stopped_state()
    assert stop["kind"] == "stopped" and "@" in stop["by"]

    before = {service: cell.inspect(service)["State"]["Pid"] for service in (executor, task)}
    for pid in before.values():
        os.kill(pid, signal.SIGKILL)
    for service, pid in before.items():
        cell.wait_for(f"{service} is back", lambda service=service, pid=pid: (
            cell.inspect(service)["State"]["Pid"] not in (0, pid) and cell.is_ready(service)), timeout)
    assert stopped_state() == (position, stop)

    cell.compose("down", "-t", "10", timeout=180)  # keeps the volume
    cell.compose("up", "-d", "--no-build", timeout=180)
    for service in (executor, task):  # new containers reset the simulated world
        cell.wait_for(f"{service} is ready", lambda service=service: cell.is_ready(service), timeout)
        position = message_of(cell, "joint_states")["position"] if service == executor else position
    assert stopped_state() == (position, stop)

    zencell(cell, "task", "start")
    cell.wait_for("the arm moves", lambda: message_of(cell, "joint_states")["position"] != position, timeout)
    assert message_of(cell, "motion/status")["interlocks"] == []
