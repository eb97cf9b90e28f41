"""Writes compose.yaml from the cells of config/cells: `python -m deploy.generate`.

A service is named once, in its cell file; a test holds that what lies here is what this writes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from common.config import Cell, load_cell, names_of

ROOT = Path(__file__).resolve().parent.parent
COMPOSE = ROOT / "compose.yaml"

ROUTER_PORT = 7447
VIEWER, VIEWER_PORT = "viewer", 8080
# What a service has taken at most in a whole run, doubled and rounded up [MB]; see docs/figures.md.
MEMORY = {"motion_planner": 768, VIEWER: 768}
USUAL_MEMORY = 384

HEAD = """\
# Made by `make deploy` from config/cells: change those, not this file.
#   docker compose up                        the Panda (COMPOSE_PROFILES in .env)
#   docker compose --profile ur5 up          the UR5
#   docker compose logs panda-viewer         the address of the operator's page
"""

# What all services share, which YAML can say but a YAML writer does not.
SHARED = f"""\
x-service: &service
  image: zencell
  build: .
  restart: unless-stopped
  read_only: true
  tmpfs: [/tmp]
  cap_drop: [ALL]
  security_opt: [no-new-privileges:true]
  mem_limit: {USUAL_MEMORY}m
  networks: [cell]
  volumes:
    - ./config:/app/config:ro
    - data:/data
  depends_on:
    router: {{condition: service_healthy}}
"""

TAIL = """\
networks:
  cell: {internal: true}
  page: {}
volumes:
  data: {}
"""


def environment(cell: str) -> dict[str, str]:
    """What every service of a cell finds in its environment."""
    return {"ZENCELL_CONNECT": f"tcp/router:{ROUTER_PORT}", "ZENCELL_CELL": cell}


def services_of(file: str, cell: Cell) -> dict[str, dict[str, Any]]:
    """The containers of a cell, in start order; the task is started when all the others are ready."""
    containers: dict[str, dict[str, Any]] = {}
    for entry in cell.services.values():
        command = ["python", "-m", entry.module]
        container: dict[str, Any] = {"profiles": [file], "command": command, "environment": environment(file)}
        if entry.name in MEMORY:
            container["mem_limit"] = f"{MEMORY[entry.name]}m"
        if entry.name == VIEWER:
            command += ["--set", "services.viewer.host=0.0.0.0"]
            container |= {"networks": ["cell", "page"], "ports": [f"127.0.0.1:${{VIEWER_PORT:-{VIEWER_PORT}}}:{VIEWER_PORT}"]}
        if entry.name == cell.task:
            container["depends_on"] = {name: {"condition": "service_healthy"} for name in ["router", *containers]}
        containers[f"{file}-{entry.name}"] = container
    return containers


def compose() -> str:
    """The text of compose.yaml."""
    cells = {name: load_cell(name) for name in names_of("cells")}
    router: dict[str, Any] = {
        "profiles": list(cells),
        "command": ["python", "-m", "services.router"],
        "environment": {"ZENCELL_CONNECT": f"tcp/127.0.0.1:{ROUTER_PORT}", "ZENCELL_LISTEN": f"tcp/0.0.0.0:{ROUTER_PORT}"},
        "depends_on": {},
    }
    blocks = [_block("router", router)]
    for name, cell in cells.items():
        blocks += [_block(service, container) for service, container in services_of(name, cell).items()]
    return HEAD + "name: zencell\n\n" + SHARED + "\nservices:\n" + "\n".join(blocks) + "\n" + TAIL


def _block(name: str, container: dict[str, Any]) -> str:
    """A service that takes over what is shared, indented as an entry of `services`."""
    text = yaml.dump(container, sort_keys=False, default_flow_style=None, width=1000)
    lines = [f"{name}:", "  <<: *service", *(f"  {line}" for line in text.splitlines())]
    return "".join(f"  {line}\n" for line in lines)


if __name__ == "__main__":
    COMPOSE.write_text(compose(), encoding="utf-8")
