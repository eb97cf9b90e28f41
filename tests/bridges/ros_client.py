"""A node of ROS 2 as rmw_zenoh makes it, of plain Zenoh and messages of rosbags: subscriptions, clients, publishers."""

from __future__ import annotations

import asyncio
import uuid
from typing import Any

import numpy as np
import zenoh
from zenoh import ext

from bridges.ros2 import convert, keys, types
from common.transport.endpoint import client_config

TIMEOUT = 20.0  # [s]
STAMP = 1_700_000_000_123_456_789


class Ros:
    """A session on the side of ROS."""

    def __init__(self, endpoint: str, domain: int) -> None:
        self.session = zenoh.open(client_config(endpoint, connect_ms=round(1e3 * TIMEOUT)))
        self.domain = domain
        self._publishers: dict[str, zenoh.Publisher] = {}

    def _tokens(self) -> list[zenoh.Reply]:
        return list(self.session.liveliness().get(f"@ros2_lv/{self.domain}/**"))

    def key(self, name: str, type_name: str, variant: types.Variant = types.JAZZY) -> str:
        return keys.data_key(self.domain, name, types.dds_name(type_name), types.type_hash(type_name, variant))

    async def tokens(self, part: str) -> str:
        """Return the token of the entity with this part, once it is there."""
        async with asyncio.timeout(TIMEOUT):
            while True:
                for reply in await asyncio.to_thread(self._tokens):
                    if reply.ok is not None and part in str(reply.ok.key_expr):
                        return str(reply.ok.key_expr)

    def subscribe(
        self, name: str, type_name: str, variant: types.Variant = types.JAZZY
    ) -> tuple[Any, asyncio.Queue[tuple[Any, keys.Attachment]]]:
        """Return a subscription, also for what is transient local, and the queue of its messages."""
        loop, found = asyncio.get_running_loop(), asyncio.Queue[tuple[Any, keys.Attachment]]()

        def on_sample(sample: zenoh.Sample) -> None:
            assert sample.attachment is not None
            message = types.store(variant).deserialize_cdr(sample.payload.to_bytes(), type_name)
            item = message, keys.Attachment.decoded(sample.attachment.to_bytes())
            loop.call_soon_threadsafe(found.put_nowait, item)

        return ext.declare_advanced_subscriber(
            self.session, self.key(name, type_name, variant), zenoh.handlers.Callback(on_sample, None, indirect=False),
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1)), found

    async def next(self, name: str, type_name: str) -> tuple[Any, keys.Attachment]:
        """Return the next message of a topic."""
        subscriber, found = self.subscribe(name, type_name)
        async with asyncio.timeout(TIMEOUT):
            item = await found.get()
        subscriber.undeclare()
        return item

    async def call(self, name: str, type_name: str, request: Any) -> Any:
        """Return the response of a service."""
        sent = keys.Attachment(17, STAMP, bytes(range(16)))

        def query() -> list[zenoh.Reply]:
            return list(self.session.get(
                self.key(name, type_name), payload=types.encode(request), attachment=sent.encoded(), timeout=TIMEOUT,
                target=zenoh.QueryTarget.ALL_COMPLETE, consolidation=zenoh.ConsolidationMode.NONE))

        replies = list[zenoh.Reply]()
        async with asyncio.timeout(TIMEOUT):
            while not replies:  # the service is not known to this session yet
                replies = await asyncio.to_thread(query)
        (reply,) = replies
        assert reply.ok is not None, reply.err
        received = keys.Attachment.decoded(reply.ok.attachment.to_bytes())
        assert (received.sequence, received.gid) == (sent.sequence, sent.gid)
        return types.decode(reply.ok.payload.to_bytes(), f"{type_name}_Response")

    def publish(self, name: str, type_name: str, message: Any, sequence: int = 1) -> None:
        """Publish a message."""
        key = self.key(name, type_name)
        if key not in self._publishers:
            self._publishers[key] = self.session.declare_publisher(key)
        self._publishers[key].put(
            types.encode(message), attachment=keys.Attachment(sequence, STAMP, bytes(16)).encoded())


class FollowClient:
    """A client of FollowJointTrajectory."""

    def __init__(self, ros: Ros, name: str) -> None:
        self.ros, self.name = ros, f"{name}/_action"

    @staticmethod
    def goal(names: list[str], *points: tuple[float, Any], **fields: Any) -> Any:
        """Return a goal of times [s] and positions, or of positions, velocities and accelerations."""
        made = []
        for time, values in points:
            rows = np.atleast_2d(np.array(values, float))
            fields_of_point = dict(zip(("positions", "velocities", "accelerations"), rows, strict=False))
            made.append(types.make("trajectory_msgs/msg/JointTrajectoryPoint", **fields_of_point,
                                   time_from_start=convert.duration_of(time)))
        trajectory = types.make("trajectory_msgs/msg/JointTrajectory", joint_names=names, points=made)
        return types.make(f"{types.FOLLOW}_Goal", **{"trajectory": trajectory, **fields})

    async def send(self, goal: Any, name: bytes | None = None) -> tuple[bytes, bool]:
        """Return the id of a goal and whether it is accepted."""
        name = name or uuid.uuid4().bytes
        request = types.make(f"{types.FOLLOW}_SendGoal_Request", goal_id=convert.uuid_of(name), goal=goal)
        answer = await self.ros.call(f"{self.name}/send_goal", f"{types.FOLLOW}_SendGoal", request)
        return name, answer.accepted

    async def result(self, goal: bytes) -> tuple[int, int, str]:
        """Return status, error code and text of a goal that is over."""
        request = types.make(f"{types.FOLLOW}_GetResult_Request", goal_id=convert.uuid_of(goal))
        answer = await self.ros.call(f"{self.name}/get_result", f"{types.FOLLOW}_GetResult", request)
        return answer.status, answer.result.error_code, answer.result.error_string

    async def cancel(self, goal: bytes = bytes(16)) -> tuple[int, list[bytes]]:
        """Cancel a goal, or all; return the code and the ids."""
        info = types.make("action_msgs/msg/GoalInfo", goal_id=convert.uuid_of(goal))
        answer = await self.ros.call(
            f"{self.name}/cancel_goal", types.CANCEL, types.make(f"{types.CANCEL}_Request", goal_info=info))
        return answer.return_code, [bytes(each.goal_id.uuid) for each in answer.goals_canceling]
