"""A client of the WebSocket protocol of Foxglove, with nothing of its SDK and nothing of zencell."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from websockets.asyncio.client import ClientConnection, connect

SUBPROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA, SERVICE_CALL_RESPONSE, SERVICE_CALL = 1, 3, 2
PATIENCE = 60.0  # [s]


class FoxgloveClient:
    """One connection. Attributes: `info`, `channels` by topic, `services` by name, and `statuses`, as they arrived."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, dict[str, Any]] = {}
        self.statuses: list[str] = []
        self._by_id: dict[int, str] = {}
        self._calls = 0

    async def receive(self) -> dict[str, Any]:
        """Return the next message; a binary one as its op, topic or call, and decoded JSON."""
        async with asyncio.timeout(PATIENCE):
            raw = await self._socket.recv()
        if isinstance(raw, bytes):
            return self._binary(raw)
        message: dict[str, Any] = json.loads(raw)
        if message["op"] == "serverInfo":
            self.info = message
        elif message["op"] == "advertise":
            for channel in message["channels"]:
                self.channels[channel["topic"]] = channel
                self._by_id[channel["id"]] = channel["topic"]
        elif message["op"] == "advertiseServices":
            self.services |= {service["name"]: service for service in message["services"]}
        elif message["op"] == "status":
            self.statuses.append(message["message"])
        return message

    def _binary(self, raw: bytes) -> dict[str, Any]:
        if raw[0] == MESSAGE_DATA:
            _, subscription, log_time = struct.unpack_from("<BIQ", raw)
            return {"op": "messageData", "topic": self._by_id[subscription], "log_time": log_time,
                    "data": json.loads(raw[13:])}
        assert raw[0] == SERVICE_CALL_RESPONSE
        _, _, call, length = struct.unpack_from("<BIII", raw)
        return {"op": "serviceCallResponse", "callId": call, "data": json.loads(raw[13 + length:])}

    async def until(self, op: str, **fields: Any) -> dict[str, Any]:
        """Return the next message with this op and these fields."""
        while True:
            message = await self.receive()
            if message["op"] == op and all(message.get(name) == value for name, value in fields.items()):
                return message

    async def channel(self, topic: str) -> dict[str, Any]:
        """Return the channel of a topic once it is advertised."""
        while topic not in self.channels:
            await self.until("advertise")
        return self.channels[topic]

    async def subscribe(self, topic: str) -> None:
        """Subscribe to a topic, under the id of its channel."""
        number = (await self.channel(topic))["id"]
        await self.send(op="subscribe", subscriptions=[{"id": number, "channelId": number}])

    async def unsubscribe(self, topic: str) -> None:
        """End a subscription."""
        await self.send(op="unsubscribe", subscriptionIds=[self.channels[topic]["id"]])

    async def data(self, topic: str) -> dict[str, Any]:
        """Return the next message of a topic."""
        return await self.until("messageData", topic=topic)

    async def call(self, service: str, request: object) -> dict[str, Any]:
        """Return the answer of a service, or its failure."""
        while service not in self.services:
            await self.until("advertiseServices")
        self._calls += 1
        head = struct.pack("<BIII", SERVICE_CALL, self.services[service]["id"], self._calls, 4)
        await self._socket.send(head + b"json" + json.dumps(request).encode())
        while True:
            message = await self.receive()
            if message["op"] in ("serviceCallResponse", "serviceCallFailure") and message["callId"] == self._calls:
                return message

    async def parameters(self, *names: str, **changes: Any) -> dict[str, Any]:
        """Return parameters by name, after changes given with __ for each dot."""
        if changes:
            values = [{"name": name.replace("__", "."), "value": value} for name, value in changes.items()]
            await self.send(op="setParameters", id="set", parameters=values)
        else:
            await self.send(op="getParameters", id="get", parameterNames=list(names))
        message = await self.until("parameterValues", id="set" if changes else "get")
        return {each["name"]: each.get("value") for each in message["parameters"]}

    async def send(self, **message: Any) -> None:
        """Send a JSON message."""
        await self._socket.send(json.dumps(message))


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[FoxgloveClient]:
    """Yield a client that has the server's information."""
    async with connect(f"ws://127.0.0.1:{port}", subprotocols=[SUBPROTOCOL], max_size=2**26) as socket:  # type: ignore[list-item]
        assert socket.subprotocol == SUBPROTOCOL
        client = FoxgloveClient(socket)
        await client.until("serverInfo")
        yield client
