"""A container whose service is frozen is unhealthy, which no engine minds: its own health check ends it."""

import os
import signal

import pytest

from tests.deploy.engine import Containers, build_image, require_engine

pytestmark = [pytest.mark.container, pytest.mark.timeout(900)]

SERVICE = "panda-vision_detector"
PATIENCE = 120.0  # [s] only ever waited for by a test that fails


@pytest.fixture(scope="module")
def cell():
    """The router and one service, ready."""
    require_engine()
    with Containers("zencell-test-frozen") as containers:
        build_image()
        containers.compose("up", "-d", "--no-build", "router", SERVICE, timeout=180)
        containers.wait_for("it is ready", lambda: containers.is_ready(SERVICE), PATIENCE)
        yield containers


@pytest.mark.parametrize("service", [SERVICE, "router"])
def test_frozen_service_is_killed_and_started_again(cell, service):
    before, started = cell.process(service), cell.inspect(service)["RestartCount"]
    other = next(each for each in (SERVICE, "router") if each != service)
    others = cell.process(other)
    os.kill(before, signal.SIGSTOP)
    cell.wait_for(f"{service} is another process", lambda: cell.process(service) not in (0, before), PATIENCE)
    cell.wait_for("the engine finds it healthy", lambda: cell.health(service) == "healthy", PATIENCE)
    assert cell.inspect(service)["RestartCount"] == started + 1
    cell.wait_for(f"{other} is ready", lambda: cell.is_ready(other), PATIENCE)
    assert cell.process(other) == others, "no other service restarts"
