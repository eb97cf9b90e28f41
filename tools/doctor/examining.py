"""All that is looked at on a machine, in the order in which it matters."""

from __future__ import annotations

from collections.abc import Iterator

from tools.doctor import cameras, certificates, clocks, configuration, leftovers, machine, network, software
from tools.doctor.finding import Finding


def examine(endpoint: str) -> Iterator[Finding]:
    """All findings; the router and its cells are looked for at an endpoint."""
    yield software.python()
    yield from software.packages()
    yield software.extras()
    yield software.kernel()
    yield from configuration.robots()
    yield from configuration.cells()
    yield network.router(endpoint)
    yield from network.versions(endpoint)
    yield from clocks.clocks(endpoint)
    yield from certificates.certificates()
    yield network.page()
    yield from cameras.cameras()
    yield from leftovers.processes()
    yield machine.shared_memory()
    yield machine.memory()
    yield machine.cores()
    yield machine.disk()
    yield machine.open_files()
    yield machine.clock()
    yield machine.container_engine()
