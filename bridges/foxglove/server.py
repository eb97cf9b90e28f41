"""Serves a cell to clients of Foxglove until cancelled."""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from typing import Any, Protocol, cast

from foxglove import Parameter, StatusLevel, start_server
from foxglove.websocket import Capability, ChannelView, Client, WebSocketServer

from bridges.cell_topics import topics_of
from bridges.foxglove import arm
from bridges.foxglove.channels import Channels
from bridges.foxglove.controls import CallFailed, Controls
from bridges.foxglove.option import require_free
from common.application import Application
from common.config import Members, RobotConfig
from common.transport.bus import Bus


class Options(Protocol):
    """Parameters of the bridge."""

    robot: RobotConfig
    members: Members
    host: str
    port: int
    commands: bool
    rate: float


BACKLOG = 256  # messages that wait for a slow client; then the oldest is dropped


class Listener:
    """A `ServerListener`: passes what clients ask for, on threads of the server, to the event loop."""

    def __init__(self, channels: Channels, controls: Controls | None) -> None:
        """Listen for a cell; without `controls` it is read only."""
        self.server: WebSocketServer | None = None
        self._channels, self._controls = channels, controls
        self._loop = asyncio.get_running_loop()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Read the topic of a channel."""
        self._call(self._channels.subscribe, channel.id)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Stop reading it, unless another client is subscribed."""
        self._call(self._channels.unsubscribe, channel.id)

    def _call(self, function: Callable[[int], None], channel: int) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(function, channel)

    def on_get_parameters(
        self, client: Client, param_names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        """Return parameters of the cell's services."""
        return self._answer(lambda controls: controls.get(param_names))

    def on_set_parameters(
        self, client: Client, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        """Change parameters; after a refusal return the values that they still have."""
        changed = self._answer(lambda controls: controls.set(parameters))
        return changed or self._answer(lambda controls: controls.get([each.name for each in parameters]))

    def on_parameters_subscribe(self, param_names: list[str]) -> None:
        """Do nothing: the server publishes the parameters that a client sets."""

    def on_parameters_unsubscribe(self, param_names: list[str]) -> None:
        """Do nothing."""

    def _answer(self, ask: Callable[[Controls], Sequence[Parameter]]) -> list[Parameter]:
        if self._controls is None:
            return []
        try:
            return list(ask(self._controls))
        except CallFailed as error:
            if self.server is not None:
                self.server.publish_status(str(error), StatusLevel.Error)
            return []


def may_command(host: str, offered: bool) -> bool:
    """Return whether clients may command the cell: the protocol has no passwords, so only from this host."""
    try:
        local = ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        local = host.lower() == "localhost"
    return offered and local


async def serve(bus: Bus, config: Options, application: Application) -> None:
    """Serve the cell until cancelled.

    Raises:
        ConfigError: the port is in use.
    """
    channels = Channels(bus, topics_of(application, config.members.keys), lambda: config.rate)
    controls = Controls(bus) if may_command(config.host, config.commands) else None
    await bus.acquire_keys()
    if config.port:
        require_free(f"services.{bus.service}.port", config.host, config.port)
    listener = Listener(channels, controls)
    server = listener.server = start_server(
        name=f"zencell {bus.cell}", host=config.host, port=config.port,
        capabilities=[Capability.Parameters, Capability.Services] if controls else [],
        server_listener=cast(Any, listener),  # it has the methods that these capabilities need
        supported_encodings=["json"], services=controls.services() if controls else [], context=channels.context,
        message_backlog_size=BACKLOG)
    try:
        channels.watch()
        channels.add(arm.KEY, arm.SCHEMA, cache(lambda: arm.arm_scene(config.robot, bus.clock.now_ns())))
        await bus.ready()
        bus.log.info("Foxglove connects to ws://%s:%d%s", config.host, server.port,
                     "" if controls else "; topics only, no commands and parameters")
        await asyncio.get_running_loop().create_future()
    finally:
        channels.close()
        server.stop()


