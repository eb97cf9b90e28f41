"""The text of compose.secure.yaml: each container gets its own certificate, the router the rules, and people a tool."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from common.transport.credentials import ACCESS, AUTHORITY, OPERATOR, ROUTER_NAME, common_name
from deploy.compose import lines_of
from deploy.containers import IMAGE, ROUTER, ROUTER_PORT, cells, containers_of
from security.page_tokens import ROLES, token_file

HEAD = """\
# Made by `make deploy`. Laid over compose.yaml; what it mounts is made by
#   zencell secure init certs --host router && sudo chown -R 10001 certs
#   docker compose -f compose.yaml -f compose.secure.yaml up
#   docker compose -f compose.yaml -f compose.secure.yaml run --rm tool topic echo joint_states --cell panda
services:
"""
INSIDE = "/certs"
OUTSIDE = "${ZENCELL_CERTS:-./certs}"
TOOL = "tool"


def compose_secure() -> str:
    """The text of compose.secure.yaml."""
    at_router = {"ZENCELL_CONNECT": f"tls/127.0.0.1:{ROUTER_PORT}", "ZENCELL_LISTEN": f"tls/0.0.0.0:{ROUTER_PORT}"}
    reached = {"ZENCELL_CONNECT": f"tls/{ROUTER}:{ROUTER_PORT}"}
    blocks = [_block(ROUTER, ROUTER_NAME, at_router, ACCESS)]
    for file, cell in cells().items():
        for container in containers_of(file, cell):
            tokens = [token_file(Path(), cell.name, role).name for role in ROLES] if container.page else []
            blocks.append(_block(f"{file}-{container.name}", common_name(cell.name, container.name), reached, *tokens))
    return HEAD + "\n".join([*blocks, _tool(reached)])


def _tool(reached: dict[str, str]) -> str:
    """A container for `run`: zencell with the operator's certificate, where the router's name is known."""
    return lines_of(TOOL, {
        "image": IMAGE, "profiles": [TOOL], "entrypoint": ["zencell"], "command": ["node", "list"],
        "init": True, "read_only": True, "tmpfs": ["/tmp"], "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges:true"], "networks": ["cell"], "healthcheck": {"disable": True},
        **_identity(OPERATOR, reached),
    })


def _block(container: str, name: str, environment: dict[str, str], *more: str) -> str:
    return lines_of(container, _identity(name, environment, *more))


def _identity(name: str, environment: dict[str, str], *more: str) -> dict[str, Any]:
    files = [f"{AUTHORITY}.pem", f"{name}.pem", f"{name}.key", *more]
    return {
        "environment": {**environment, "ZENCELL_SECURE": INSIDE},
        "volumes": [f"{OUTSIDE}/{file}:{INSIDE}/{file}:ro" for file in files],
    }
