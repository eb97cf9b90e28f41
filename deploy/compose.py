"""The text of compose.yaml: one container for each service of each cell, and the router."""

from __future__ import annotations

from typing import Any

import yaml

from deploy.containers import (
    CONFIG,
    DATA,
    IMAGE,
    ROUTER,
    USUAL_MEMORY,
    VIEWER_PORT,
    Container,
    cells,
    containers_of,
    router,
)
from security.page_tokens import TOKEN_VARIABLE

HEAD = """\
# Made by `make deploy` from config/cells: change those, not this file.
#   docker compose up                      the Panda (COMPOSE_PROFILES in .env)
#   docker compose --profile ur5 up        the UR5
#   docker compose logs panda-viewer       the address of the operator's page
name: zencell
"""

# YAML can say it once for all services, but a YAML writer does not.
SHARED = f"""
x-service: &service
  image: {IMAGE}
  build: .
  restart: unless-stopped
  init: true   # so that the health check can kill a service that is frozen
  read_only: true
  tmpfs: [/tmp]
  cap_drop: [ALL]
  security_opt: [no-new-privileges:true]
  mem_limit: {USUAL_MEMORY}m
  networks: [cell]
  volumes:
    - ./config:{CONFIG}:ro
    - data:{DATA}
  depends_on:
    {ROUTER}: {{condition: service_healthy}}

services:
"""

TAIL = """
networks:
  cell: {internal: true}   # nothing in it reaches the outside, nor is reached from there
  page: {}
volumes:
  data: {}                 # recordings, stages, and what persons stopped or hold: keep it
"""


DEV_HEAD = """\
# Made by `make deploy`. For work on the code: it is mounted, and a service starts again when a file of it changes.
#   docker compose -f compose.yaml -f compose.dev.yaml up --build
services:
"""
SOURCE = ("common", "services", "cli", "applications", "page", "drivers", "recording", "tools", "lab", "security")


def compose_dev() -> str:
    """The text of compose.dev.yaml, which is laid over compose.yaml."""
    names = {ROUTER: router()}
    for file, cell in cells().items():
        names |= {f"{file}-{container.name}": container for container in containers_of(file, cell)}
    blocks = []
    for name, container in names.items():
        started = " ".join([*container.command, *container.arguments])
        blocks.append(lines_of(name, {
            "image": f"{IMAGE}-dev",
            "build": {"context": ".", "target": "dev"},
            "volumes": [f"./{folder}:/app/{folder}:ro" for folder in SOURCE],
            "command": ["watchfiles", "--filter", "deploy.watched.concerns", started,
                        *(f"/app/{folder}" for folder in SOURCE)],
        }))
    return DEV_HEAD + "\n".join(blocks)


def compose() -> str:
    """The text of compose.yaml."""
    all_cells = cells()
    blocks = [_block(ROUTER, {"profiles": list(all_cells), **_what_it_runs(router()), "depends_on": {}})]
    for file, cell in all_cells.items():
        before = [ROUTER]
        for container in containers_of(file, cell):
            name = f"{file}-{container.name}"
            blocks.append(_block(name, {"profiles": [file], **_what_it_runs(container), **_extras(container, before)}))
            before.append(name)
    return HEAD + SHARED + "\n".join(blocks) + TAIL


def _what_it_runs(container: Container) -> dict[str, Any]:
    return {"command": [*container.command, *container.arguments], "environment": container.environment}


def _extras(container: Container, before: list[str]) -> dict[str, Any]:
    extras: dict[str, Any] = {}
    if container.memory != USUAL_MEMORY:
        extras["mem_limit"] = f"{container.memory}m"
    if container.page:
        published = f"127.0.0.1:${{ZENCELL_PAGE:-{VIEWER_PORT}}}:{VIEWER_PORT}"
        token = {TOKEN_VARIABLE: f"${{{TOKEN_VARIABLE}:-}}"}
        extras |= {"networks": ["cell", "page"], "ports": [published], "environment": container.environment | token}
    if container.is_task:
        extras["depends_on"] = {name: {"condition": "service_healthy"} for name in before}
    return extras


def _block(name: str, container: dict[str, Any]) -> str:
    """A service that takes over what is shared."""
    return lines_of(name, container, "<<: *service")


def lines_of(name: str, container: dict[str, Any], *first: str) -> str:
    """A service, indented as an entry of `services`."""
    lines = [f"{name}:", *(f"  {line}" for line in first)]
    for key, value in container.items():
        text = yaml.dump(value, default_flow_style=True, width=10_000, sort_keys=False).removesuffix("...\n").strip()
        lines.append(f"  {key}: {text}")
    return "".join(f"  {line}\n" for line in lines)
