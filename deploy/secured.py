"""The text of compose.secure.yaml: each container gets its own certificate, and the router the rules."""

from __future__ import annotations

from common.security.credentials import ACCESS, AUTHORITY, ROUTER_NAME, common_name
from deploy.compose import lines_of
from deploy.containers import ROUTER, ROUTER_PORT, cells, containers_of

HEAD = """\
# Made by `make deploy`. Laid over compose.yaml; what it mounts is made by
#   zencell secure init certs --host router && sudo chown -R 10001 certs
#   docker compose -f compose.yaml -f compose.secure.yaml up
services:
"""
INSIDE = "/certs"
OUTSIDE = "${ZENCELL_CERTS:-./certs}"


def compose_secure() -> str:
    """The text of compose.secure.yaml."""
    at_router = {"ZENCELL_CONNECT": f"tls/127.0.0.1:{ROUTER_PORT}", "ZENCELL_LISTEN": f"tls/0.0.0.0:{ROUTER_PORT}"}
    blocks = [_block(ROUTER, ROUTER_NAME, at_router, ACCESS)]
    for file, cell in cells().items():
        for container in containers_of(file, cell):
            reached = {"ZENCELL_CONNECT": f"tls/{ROUTER}:{ROUTER_PORT}"}
            blocks.append(_block(f"{file}-{container.name}", common_name(cell.name, container.name), reached))
    return HEAD + "\n".join(blocks)


def _block(container: str, name: str, environment: dict[str, str], *more: str) -> str:
    files = [f"{AUTHORITY}.pem", f"{name}.pem", f"{name}.key", *more]
    return lines_of(container, {
        "environment": {**environment, "ZENCELL_SECURE": INSIDE},
        "volumes": [f"{OUTSIDE}/{file}:{INSIDE}/{file}:ro" for file in files],
    })
