"""A node of ROS 2: its publishers, subscriptions and services, as rmw_zenoh declares them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Coroutine
from functools import partial
from typing import Any

from bridges.ros2 import keys, types
from bridges.ros2.keys import TRANSIENT_LOCAL, Attachment, Node, Qos
from common.errors import ZencellError
from common.time_source import wall_ns
from common.transport.foreign import RAW, ForeignSession
from common.transport.session import Query, RawSample, call_on_loop

HEARTBEAT = 0.5  # [s] SAMPLE_MISS_DETECTION_HEARTBEAT_PERIOD of rmw_zenoh
SERVICE_QOS = Qos(depth=10)

Handler = Callable[[Any], Awaitable[Any]]  # from the message of a request to that of the response


class Publisher:
    """Publishes messages of one type under one name; from one thread at a time."""

    def __init__(self, graph: Graph, name: str, type_name: str, qos: Qos, variant: types.Variant) -> None:
        """Declare the publisher and its token; with TRANSIENT_LOCAL it has a cache for late subscriptions."""
        self.name, self.type_name, self.qos = name, type_name, qos
        key, token = graph.entity("MP", name, type_name, qos, variant)
        self._gid, self._sequence, self._variant = keys.gid_of(token), 0, variant
        self._publisher = graph.session.foreign_publisher(
            key, reliable=qos.reliability == keys.RELIABLE, heartbeat=HEARTBEAT,
            cached=qos.depth if qos.durability == TRANSIENT_LOCAL else 0)
        self.watch = self._publisher.watch
        graph.session.token(token)

    def put(self, message: Any) -> None:
        """Publish a message; a congested network drops it."""
        self._sequence += 1
        attachment = Attachment(self._sequence, wall_ns(), self._gid)
        self._publisher.put(types.encode(message, self._variant), attachment.encoded())

    @property
    def matched(self) -> bool:
        """Whether there is a subscription."""
        return self._publisher.matched


class Graph:
    """One node on one session. Services are answered on the running loop, while `run` runs."""

    def __init__(self, session: ForeignSession, domain: int, namespace: str, name: str, log: logging.Logger) -> None:
        """Announce the node; closing the session withdraws it."""
        self.session, self._log = session, log
        self.node = Node(domain, session.id, namespace, name)
        self._entities = 0
        self._loop = asyncio.get_running_loop()
        self._requests: asyncio.Queue[Callable[[], Coroutine[Any, Any, None]]] = asyncio.Queue()
        session.token(self.node.token())

    async def run(self) -> None:
        """Answer requests concurrently until cancelled.

        Raises:
            ExceptionGroup: of any error that a handler raises and that is no `ZencellError`: it is a bug.
        """
        async with asyncio.TaskGroup() as group:
            while True:
                answer = await self._requests.get()
                group.create_task(answer())

    def entity(
        self, kind: keys.Kind, name: str, type_name: str, qos: Qos, variant: types.Variant = types.JAZZY
    ) -> tuple[str, str]:
        """Return the key and the token of a new entity."""
        self._entities += 1
        dds, type_hash = types.dds_name(type_name), types.type_hash(type_name, variant)
        token = self.node.entity_token(self._entities, kind, name, dds, type_hash, qos)
        return keys.data_key(self.node.domain, name, dds, type_hash), token

    def publisher(
        self, name: str, type_name: str, qos: Qos, variant: types.Variant = types.JAZZY
    ) -> Publisher:
        """Return a new publisher."""
        return Publisher(self, name, type_name, qos, variant)

    def subscribe(self, name: str, type_name: str, qos: Qos, on_sample: Callable[[RawSample], None]) -> None:
        """Call back on the network's thread for each message of a topic, still encoded."""
        key, token = self.entity("MS", name, type_name, qos)
        self.session.subscriber(key, on_sample)
        self.session.token(token)

    def service(self, name: str, type_name: str, handler: Handler) -> None:
        """Answer requests with `await handler(request)`, concurrently.

        A malformed request, and one whose handler raises a `ZencellError`, gets an error reply and is logged in a line.
        Any other error also ends `run`.
        """
        key, token = self.entity("SS", name, type_name, SERVICE_QOS)

        def on_query(query: Query) -> None:  # on the network's thread
            answer = partial(self._answer, query, key, name, type_name, handler)
            call_on_loop(self._loop, lambda: self._requests.put_nowait(answer))

        self.session.queryable(key, on_query, complete=True)
        self.session.token(token)

    async def _answer(self, query: Query, key: str, name: str, type_name: str, handler: Handler) -> None:
        try:
            try:
                attachment = Attachment.decoded(query.attachment or b"")
                request = types.decode(query.payload or b"", f"{type_name}_Request")
            except ValueError as error:
                self._refuse(query, name, error)
                return
            response = types.encode(await handler(request))
            reply = Attachment(attachment.sequence, wall_ns(), attachment.gid)
            query.reply(key, response, RAW, reply.encoded())
        except ZencellError as error:
            self._refuse(query, name, error)
        except Exception as error:
            query.refuse(f"{type(error).__name__}: {error}".encode())
            raise
        finally:
            query.finish()

    def _refuse(self, query: Query, name: str, error: Exception) -> None:
        self._log.warning("%s: %s", name, error)
        query.refuse(str(error).encode())
