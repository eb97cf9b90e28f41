"""Serves the parameters of a service; done for every service where it is started, not by the service."""

from __future__ import annotations

from common import topics
from common.config import Parameters
from common.config.tunables import apply, checked, describe, values_of
from common.messages import ParameterReply, ParameterRequest
from common.transport.bus import Bus


def serve_parameters(bus: Bus, config: Parameters) -> None:
    """Answer `param/<service>`: what there is, and changes, made in place between two turns of the loop."""
    started = values_of(config, bus.service)

    async def handle(request: ParameterRequest) -> ParameterReply:
        changes = checked(config, bus.service, request.set)
        if changes and not request.dry_run:
            lines = [str(change) for change in changes]
            apply(changes)
            for line in lines:
                bus.log.info("%s (by %s)", line, request.by or "somebody")
            bus.parameters_changed()
            await bus.save_parameters()
        parameters = describe(config, bus.service, started)
        return ParameterReply(header=bus.header(), service=bus.service, parameters=parameters)

    bus.serve(topics.parameters_of(bus.service), handle)
