"""Containers of each cell, for compose.yaml and Kubernetes: commands, environment, memory."""

from __future__ import annotations

from dataclasses import dataclass, field

from common.atomic_file import STATE_VARIABLE
from common.clock import CLOCK_FOLDER_VARIABLE
from common.config import Cell, load_cell, names_of

IMAGE = "zencell"
ROUTER, ROUTER_PORT = "router", 7447
VIEWER, VIEWER_PORT = "viewer", 8080
# Services with persistent state: operator interlocks, the simulated world, the task's memory.
PERSISTENT = ("trajectory_executor", "scene_manager", "outline_scene", "smart_pick_place")
CONFIG = "/app/config"
DATA = "/data"
# A container's port is published to the loopback of its host only.
PAGE = ["--set", "services.{name}.host=0.0.0.0", "--set", "services.{name}.published=true"]
USER = 10001  # as in the Dockerfile
# About twice the peak of a complete run [MB], see benchmarks/resources.py.
MEMORY = {"motion_planner": 768, VIEWER: 768}
USUAL_MEMORY = 384


@dataclass(frozen=True)
class Container:
    """One service of a cell."""

    name: str
    command: list[str]
    environment: dict[str, str]
    memory: int = USUAL_MEMORY  # [MB]
    is_task: bool = False  # starts after all others are ready
    page: bool = False  # publishes the operator's page
    arguments: list[str] = field(default_factory=list)  # only where the engine publishes ports


def cells() -> dict[str, Cell]:
    """Return the cells of config/cells by file name."""
    return {name: load_cell(name) for name in names_of("cells")}


def router() -> Container:
    """Return the router, which all cells share."""
    environment = {"ZENCELL_CONNECT": f"tcp/127.0.0.1:{ROUTER_PORT}", "ZENCELL_LISTEN": f"tcp/0.0.0.0:{ROUTER_PORT}"}
    return Container(ROUTER, ["python", "-m", "services.router"], environment)


def containers_of(file: str, cell: Cell) -> list[Container]:
    """Return the services of a cell in start order."""
    environment = {"ZENCELL_CONNECT": f"tcp/{ROUTER}:{ROUTER_PORT}", "ZENCELL_CELL": file, CLOCK_FOLDER_VARIABLE: DATA}
    state = {kind: {STATE_VARIABLE: DATA} for kind in PERSISTENT}
    return [
        Container(
            entry.name, ["python", "-m", entry.module, *entry.name_option], environment | state.get(entry.kind, {}),
            MEMORY.get(entry.kind, USUAL_MEMORY),
            is_task=entry.name == cell.task, page=entry.kind == VIEWER,
            arguments=[part.format(name=entry.name) for part in PAGE] if entry.kind == VIEWER else [],
        )
        for entry in cell.services.values()
    ]
