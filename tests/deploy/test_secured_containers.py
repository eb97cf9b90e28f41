"""compose.secure.yaml in an engine: the operator's certificate gives access, and no certificate gives none."""

import json
from pathlib import Path

import pytest

from deploy.compose import USER
from deploy.generate import ROOT
from tests.deploy.engine import Containers, build_image, require_engine, run

pytestmark = [pytest.mark.container, pytest.mark.timeout(900)]

PROJECT = "zencell-test-secure"
SERVICE = "panda-trajectory_executor"
PATIENCE = 120.0  # [s] only ever waited for by a test that fails
READ = ("topic", "echo", "motion/status", "--cell", "panda", "--count", "1")


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """The router and the executor with certificates that the image itself made, as its own user."""
    require_engine()
    folder = tmp_path_factory.mktemp("certificates")
    files = ("compose.yaml", "compose.secure.yaml")
    with Containers(PROJECT, files, ROOT, {"ZENCELL_CERTS": str(folder / "certs")}) as containers:
        build_image()
        own(folder, USER)
        run("docker", "run", "--rm", "-v", f"{folder}:/made", "zencell", "zencell", "secure", "init", "/made/certs",
            "--host", "router", timeout=200)
        try:
            containers.compose("up", "-d", "--no-build", "router", SERVICE, timeout=180)
            yield containers
        finally:
            own(folder, folder.parent.stat().st_uid)


def own(folder: Path, user: int) -> None:
    """Give a folder to a user, which on the host only root can."""
    run("docker", "run", "--rm", "--user", "root", "-v", f"{folder}:/made", "zencell", "chown", "-R", str(user),
        "/made")


def test_containers_get_ready_behind_their_certificates(cell):
    for service in ("router", SERVICE):
        cell.wait_for(f"{service} is ready", lambda s=service: cell.is_ready(s), PATIENCE)


def test_tool_with_the_operators_certificate_reads_the_status(cell):
    line = cell.compose("run", "--rm", "-T", "tool", *READ, timeout=200)
    assert json.loads(line)["state"] == "none", "no client has sent a goal"


def test_tool_without_a_certificate_finds_no_router(cell):
    said = cell.refused("run", "--rm", "-T", "-e", "ZENCELL_SECURE=", "tool", *READ, timeout=200)
    assert "no router at tls/router:7447" in said


def test_container_has_its_own_key_and_no_others(cell):
    keys = cell.compose("exec", "-T", SERVICE, "sh", "-c", "ls /certs/*.key").split()
    assert keys == ["/certs/panda.trajectory_executor.key"]
