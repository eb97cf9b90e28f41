"""Publishes the cell to ROS 2 with rmw_zenoh, and takes its task commands (extra `ros2`)."""

from __future__ import annotations

from pydantic import Field

from bridges.ros2.option import require_usable
from common.application import find_application
from common.config import Members, Parameters, RobotConfig, Run, Tunable
from common.process.service import main
from common.transport.bus import Bus


class Config(Parameters):
    """Domain, names, rights of clients, and rates."""

    robot: RobotConfig
    run: Run
    members: Members
    domain: int = Field(0, ge=0, le=232, description="ROS_DOMAIN_ID")
    namespace: str = Field("", max_length=100, description="namespace of names in ROS; empty: the name of the cell")
    commands: bool = Field(True, description="offer task commands")
    trajectories: bool = Field(True, description="offer the action FollowJointTrajectory, which moves the arm")
    rate: Tunable[float] = Field(200.0, gt=0, le=1000, description="maximum rate of each stream, wall time [Hz]")


async def run(bus: Bus, config: Config) -> None:
    """Publish the cell until cancelled.

    Raises:
        ConfigError: a package is missing, or the cell is secured.
    """
    require_usable(f"services.{bus.service}", ...)
    from bridges.ros2.server import serve

    await serve(bus, config, find_application(config.members.application))


if __name__ == "__main__":
    main(run, Config)
