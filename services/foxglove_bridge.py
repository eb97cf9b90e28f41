"""Serves the topics, task commands and parameters of the cell to Foxglove (extra `foxglove`)."""

from __future__ import annotations

from pydantic import Field

from bridges.foxglove.option import require_usable
from common.application import find_application
from common.config import Members, Parameters, RobotConfig, Run, Tunable
from common.process.service import main
from common.transport.bus import Bus


class Config(Parameters):
    """Address, rights of clients, and rates."""

    robot: RobotConfig
    run: Run
    members: Members
    host: str = Field(
        "127.0.0.1", min_length=1, description="listening address; clients of any other than this host's own see "
                                               "topics only"
    )
    port: int = Field(8765, ge=0, le=65535, description="TCP port; 0: any free port")
    commands: bool = Field(
        True, description="offer task commands and parameters to clients of this host"
    )
    rate: Tunable[float] = Field(30.0, gt=0, le=1000, description="maximum rate of each stream, wall time [Hz]")


async def run(bus: Bus, config: Config) -> None:
    """Serve Foxglove until cancelled.

    Raises:
        ConfigError: the package is missing, the port is in use, or the cell is secured.
    """
    require_usable(f"services.{bus.service}", ...)
    from bridges.foxglove.server import serve

    await serve(bus, config, find_application(config.members.application))


if __name__ == "__main__":
    main(run, Config)
