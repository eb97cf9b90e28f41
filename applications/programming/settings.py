"""Parameters of the program runner."""

from __future__ import annotations

from pydantic import Field

from common.config import Grasp, Surroundings, Tunable
from common.tasks.decisions import TaskConfig


class Config(TaskConfig):
    """Parameters of the program runner; times are cell time unless they say wall."""

    world: Surroundings
    grasp: Grasp = Grasp()
    folder: str = Field("programs", description="folder of the programs, relative to the working directory")
    program: str = Field("", description="program to load at the start: a name in the folder, or a path")
    progress: str = Field("", description="file in which the progress also outlives the cell; default: none")
    attempts: Tunable[int] = Field(5, ge=1, le=100, description="of a step whose motion fails, before the program "
                                                                "stops with an error")
    frame_timeout: Tunable[float] = Field(
        3.0, ge=0.1, le=60, description="an older picture shows no object to pick [s, wall time]")
