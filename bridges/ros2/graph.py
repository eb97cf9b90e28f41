"""A node of ROS 2 on a Zenoh session of its own: its publishers and services, as rmw_zenoh declares them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Any

import zenoh
from zenoh import ext

from bridges.ros2 import keys, types
from bridges.ros2.keys import TRANSIENT_LOCAL, Attachment, Node, Qos
from common.time_source import wall_ns
from common.transport.endpoint import client_config

CONNECT_MS = 5000
HEARTBEAT = 0.5  # [s] SAMPLE_MISS_DETECTION_HEARTBEAT_PERIOD of rmw_zenoh
SERVICE_QOS = Qos(depth=10)

Handler = Callable[[Any], Awaitable[Any]]  # from the message of a request to that of the response


class Publisher:
    """Publishes messages of one type under one name; from one thread at a time."""

    def __init__(self, graph: Graph, name: str, type_name: str, qos: Qos) -> None:
        """Declare the publisher and its token; with TRANSIENT_LOCAL it has a cache for late subscriptions."""
        self.name, self.type_name, self.qos = name, type_name, qos
        key, token = graph.entity("MP", name, type_name, qos)
        self._gid, self._sequence = keys.gid_of(token), 0
        reliability = (zenoh.Reliability.RELIABLE if qos.reliability == keys.RELIABLE
                       else zenoh.Reliability.BEST_EFFORT)
        self._publisher: Any
        if qos.durability == TRANSIENT_LOCAL:
            self._publisher = ext.declare_advanced_publisher(
                graph.session, key, congestion_control=zenoh.CongestionControl.DROP, reliability=reliability,
                cache=ext.CacheConfig(max_samples=qos.depth), publisher_detection=True,
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT))
        else:
            self._publisher = graph.session.declare_publisher(
                key, congestion_control=zenoh.CongestionControl.DROP, reliability=reliability)
        graph.announce(token)

    def put(self, message: Any) -> None:
        """Publish a message; a congested network drops it."""
        self._sequence += 1
        attachment = Attachment(self._sequence, wall_ns(), self._gid)
        self._publisher.put(types.encode(message), attachment=attachment.encoded())

    def watch(self, on_change: Callable[[bool], None]) -> None:
        """Call back, on the network's thread, when the first subscription appears and when the last one is gone."""
        self._publisher.declare_matching_listener(
            zenoh.handlers.Callback(lambda status: on_change(status.matching), None, indirect=False))

    @property
    def matched(self) -> bool:
        """Whether there is a subscription."""
        return bool(self._publisher.matching_status.matching)


class Graph:
    """One node on one session. Services are answered on the event loop that was running when it was made."""

    def __init__(self, endpoint: str, domain: int, namespace: str, name: str, log: logging.Logger) -> None:
        """Connect to a router and announce the node; may block for seconds.

        Raises:
            zenoh.ZError: there is no router.
        """
        self.session = zenoh.open(client_config(endpoint, connect_ms=CONNECT_MS))
        self.node = Node(domain, str(self.session.info.zid()), namespace, name)
        self._log, self._tokens, self._queryables = log, list[Any](), list[Any]()
        self._publishers: list[Publisher] = []
        self._entities = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self.announce(self.node.token())

    def entity(self, kind: keys.Kind, name: str, type_name: str, qos: Qos) -> tuple[str, str]:
        """Return the key and the token of a new entity."""
        self._entities += 1
        dds, type_hash = types.dds_name(type_name), types.type_hash(type_name)
        token = self.node.entity_token(self._entities, kind, name, dds, type_hash, qos)
        return keys.data_key(self.node.domain, name, dds, type_hash), token

    def announce(self, token: str) -> None:
        """Declare a token until `close`."""
        self._tokens.append(self.session.liveliness().declare_token(token))

    def publisher(self, name: str, type_name: str, qos: Qos) -> Publisher:
        """Return a new publisher; it stays until `close`."""
        made = Publisher(self, name, type_name, qos)
        self._publishers.append(made)  # Zenoh undeclares one that is garbage
        return made

    def service(self, name: str, type_name: str, handler: Handler) -> None:
        """Answer requests with `await handler(request)`, concurrently, on the running loop.

        A malformed request, and one whose handler raises, gets an error reply and is logged.
        """
        loop = asyncio.get_running_loop()
        key, token = self.entity("SS", name, type_name, SERVICE_QOS)

        def on_query(query: zenoh.Query) -> None:  # on the network's thread
            loop.call_soon_threadsafe(start, query)

        def start(query: zenoh.Query) -> None:
            task = loop.create_task(self._answer(query, key, name, type_name, handler))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

        self._queryables.append(self.session.declare_queryable(
            key, zenoh.handlers.Callback(on_query, None, indirect=False), complete=True))
        self.announce(token)

    async def _answer(self, query: zenoh.Query, key: str, name: str, type_name: str, handler: Handler) -> None:
        try:
            attachment = Attachment.decoded(query.attachment.to_bytes() if query.attachment is not None else b"")
            data = query.payload.to_bytes() if query.payload is not None else b""
            response = types.encode(await handler(types.decode(data, f"{type_name}_Request")))
            reply = Attachment(attachment.sequence, wall_ns(), attachment.gid)
            query.reply(key, response, attachment=reply.encoded())
        except asyncio.CancelledError:
            raise
        except Exception as error:  # of one request: the others continue
            self._log.warning("%s: %s", name, error)
            query.reply_err(str(error).encode())
        finally:
            query.drop()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Withdraw everything; may block for a moment."""
        for task in self._tasks:
            task.cancel()
        for declared in (*self._queryables, *reversed(self._tokens)):
            declared.undeclare()
        self.session.close()  # type: ignore[no-untyped-call]
