"""Publishes a cell in a domain of ROS 2 until cancelled."""

from __future__ import annotations

import asyncio
import xml.etree.ElementTree as ET
from typing import Protocol

from bridges.cell_topics import topics_of
from bridges.ros2 import convert, keys
from bridges.ros2.action import TrajectoryAction
from bridges.ros2.controls import Commands
from bridges.ros2.graph import Graph, Publisher
from bridges.ros2.scene_check import SceneCheck
from bridges.ros2.topics import Topics
from bridges.ros2.types import make
from common.application import Application
from common.config import Members, RobotConfig
from common.messages import TaskStatus
from common.transport.bus import Bus
from common.transport.endpoint import endpoint_of
from common.transport.foreign import open_foreign

CLOCK_PERIOD = 0.02  # [s] wall


class Options(Protocol):
    """Parameters of the bridge."""

    robot: RobotConfig
    members: Members
    domain: int
    namespace: str
    commands: bool
    trajectories: bool
    rate: float


async def serve(bus: Bus, config: Options, application: Application, endpoint: str | None = None) -> None:
    """Serve the cell until cancelled; `endpoint` is that of a router, by default the cell's."""
    endpoint = endpoint or bus.endpoint or endpoint_of()
    found = topics_of(application, config.members.keys)
    topics = Topics(bus, found, lambda: config.rate)
    commands = Commands(bus) if config.commands else None
    tasks = [topic for topic in found if issubclass(topic.message, TaskStatus)]
    action = TrajectoryAction(bus, tasks) if config.trajectories else None
    await bus.acquire_keys()
    namespace = "/" + keys.ros_name(config.namespace or bus.cell)
    description = await asyncio.to_thread(description_of, config.robot)
    check = await asyncio.to_thread(SceneCheck, config.robot) if action else None
    session = await open_foreign(endpoint)
    try:
        graph = Graph(session, config.domain, namespace, "zencell", bus.log)
        graph.publisher(f"{namespace}/robot_description", "std_msgs/msg/String", keys.LATCHED).put(
            convert.text(description))
        if commands is not None:
            commands.serve(graph)
        async with asyncio.TaskGroup() as group:
            group.create_task(graph.run())
            if action is not None and check is not None:
                action.serve(graph, check)
                group.create_task(action.run())
            topics.watch(graph)
            try:
                await bus.ready()
                bus.log.info("ROS 2 domain %d, namespace %s, with rmw_zenoh at %s", config.domain, namespace, endpoint)
                await _publish_clock(bus, graph.publisher("/clock", "rosgraph_msgs/msg/Clock", keys.LATEST))
            finally:
                topics.close()
    finally:
        await asyncio.to_thread(session.close)


def description_of(robot: RobotConfig) -> str:
    """Return the robot as one URDF, whose meshes are URLs of files of this host.

    Raises:
        ConfigError: a description is missing or does not parse.
    """
    from common.robot.urdf import merged_urdf  # slow to import

    root = ET.fromstring(merged_urdf(robot))
    for mesh in root.iter("mesh"):
        if (path := mesh.get("filename", "")).startswith("/"):
            mesh.set("filename", f"file://{path}")
    return ET.tostring(root, encoding="unicode")


async def _publish_clock(bus: Bus, publisher: Publisher) -> None:
    """Publish cell time while there is a subscription, for nodes with use_sim_time."""
    while True:
        if publisher.matched:
            publisher.put(make("rosgraph_msgs/msg/Clock", clock=convert.time_of(bus.clock.now_ns())))
        await asyncio.sleep(CLOCK_PERIOD)
