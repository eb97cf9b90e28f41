"""Publish joint states of ROS 2 as the cell's, where the arm is moved by ROS (extra `ros2`)."""

from __future__ import annotations

import asyncio
import math
from typing import Any

from pydantic import Field

from bridges.ros2.inputs import SILENCE, InputConfig, ProblemLog, inputs, stamp_of, usable_endpoint
from common import topics
from common.config import RobotConfig, check
from common.errors import ConfigError
from common.messages import Header, JointState
from common.process.service import main
from common.transport.bus import Bus


class Config(InputConfig):
    """The topic. A cell with it has no trajectory_executor, which publishes the joint states of an arm of its own."""

    robot: RobotConfig
    topic: str = Field("/joint_states", max_length=200, description="of sensor_msgs/JointState")


def converted(message: Any, joints: list[str]) -> JointState:
    """Return a sensor_msgs/JointState as a message of the cell, with its stamp.

    Args:
        message: of ROS; velocities and efforts that are not finite are left out.
        joints: that must be there.

    Raises:
        ValueError, ConfigError: why it cannot be used.
    """
    names = list(message.name)
    if missing := [name for name in joints if name not in names]:
        raise ValueError(f"no {', '.join(missing)} among {', '.join(names) or 'no joints'}: the robot file has other "
                         "names, or another node publishes them")
    if not (stamp := stamp_of(message.header)):
        raise ValueError("joint states have no stamp")
    velocity, effort = ([float(v) for v in values] if all(map(math.isfinite, values)) else []
                        for values in (message.velocity, message.effort))
    return check(JointState, {
        "header": Header(stamp=stamp), "name": names, "position": [float(v) for v in message.position],
        "velocity": velocity, "effort": effort}, "joint states")


async def run(bus: Bus, config: Config) -> None:
    """Publish joint states with the stamps of ROS as they arrive.

    Raises:
        ConfigError: no topic is named, a package is missing, or the cell is secured.
    """
    states = bus.writer(topics.JOINT_STATES)
    endpoint = usable_endpoint(bus, config, config.topic)
    await bus.ready()
    problems = ProblemLog(bus, config.topic, config.domain)
    async with inputs(bus, endpoint, config.domain, (config.topic, "sensor_msgs/msg/JointState")) as (given,):
        while True:
            try:
                async with asyncio.timeout(SILENCE):
                    message = await given.next()
                state = converted(message, config.robot.joints)
            except TimeoutError:
                problems.left_out(f"no message for {SILENCE:g} s: is its node up, with rmw_zenoh on the same router?")
            except (ValueError, ConfigError) as error:
                problems.left_out(str(error))
            else:
                states.put(state)
                problems.used(state.header.stamp)


if __name__ == "__main__":
    main(run, Config)
