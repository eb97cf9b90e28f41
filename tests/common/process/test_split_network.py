"""Two hosts run the same service and link their routers later: one service survives, and both report it."""

import pytest

from common.transport.endpoint import port_of
from tests.common.process.test_processes import CELL
from tests.common.transport.conftest import Processes, until
from tests.harness import free_domain


@pytest.mark.slow
async def test_first_of_two_services_survives_when_their_hosts_are_linked_later(processes: Processes) -> None:
    domains = free_domain(), free_domain()
    routers = [processes.start("services.router", "--domain", str(domain)) for domain in domains]
    toys = []
    for domain in domains:
        toys.append(processes.start("tests.common.process.toy", "--cell", CELL, "--domain", str(domain)))
        await processes.printed(toys[-1], "is ready")
    routers[1].kill()
    routers[1].wait()
    processes.start("services.router", "--domain", str(domains[1]), "--link", f"tcp/127.0.0.1:{port_of(domains[0])}")
    await until(lambda: toys[1].poll() is not None)
    assert toys[1].returncode == 2 and toys[0].poll() is None
    assert "was there first: this one ends" in processes.output(toys[1])
    await processes.printed(toys[0], "gives way: this one was there first")
