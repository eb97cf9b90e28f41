"""What the supervisors of other hosts say of their part of the cell, so that each of them can tell of all of it."""

from __future__ import annotations

from collections.abc import Collection

from common.messages import ServiceStatus, SupervisorStatus


class Elsewhere:
    """The services of a cell that other supervisors keep."""

    def __init__(self, host: str, own: Collection[str]) -> None:
        """Know of none yet.

        Args:
            host: name of this host.
            own: names of the services that run here.
        """
        self.host, self._own = host, frozenset(own)
        self._heard: dict[str, ServiceStatus] = {}

    def hear(self, status: SupervisorStatus) -> None:
        """Take note of what a supervisor says of its own part; what it passes on is not news."""
        for service in status.services:
            if service.name not in self._own and service.host == status.host:
                self._heard[service.name] = service

    def statuses(self, alive: Collection[str]) -> list[ServiceStatus]:
        """All of them as they are now: a host that can not be reached does not tell any more.

        Args:
            alive: names of the services whose readiness tokens are there.
        """
        return [
            service if service.name in alive or service.state != "ready" else service.model_copy(update={
                "state": "waiting", "message": f"on {service.host}, which is not reached",
            })
            for service in self._heard.values()
        ]

    def ours(self, services: Collection[ServiceStatus]) -> list[ServiceStatus]:
        """Those of this host, with its name."""
        return [service.model_copy(update={"host": self.host}) for service in services]
