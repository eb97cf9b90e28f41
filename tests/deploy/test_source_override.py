"""compose.dev.yaml in an engine: a service restarts when its source changes, and waits while that does not parse."""

import shutil
from pathlib import Path

import pytest

from deploy.generate import ROOT
from tests.deploy.engine import Containers, require_engine

pytestmark = [pytest.mark.container, pytest.mark.timeout(900)]

SERVICE, OTHER = "panda-vision_detector", "panda-workspace_validator"
FILES = ("compose.yaml", "compose.dev.yaml", "Dockerfile", ".dockerignore", ".env")
PATIENCE = 120.0  # [s] only ever waited for by a test that fails


@pytest.fixture
def cell(tmp_path):
    """The router and two services on a copy of the source, ready."""
    require_engine()
    for name in (*FILES, *copied()):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(ROOT / name, tmp_path / name)
    files = ("compose.yaml", "compose.dev.yaml")
    with Containers("zencell-test-source", files, tmp_path) as containers:
        containers.compose("build", "router", timeout=800)
        containers.compose("up", "-d", "--no-build", "router", SERVICE, OTHER, timeout=180)
        for service in ("router", SERVICE, OTHER):
            containers.wait_for(f"{service} is ready", lambda s=service: containers.is_ready(s), PATIENCE)
        yield containers


def copied() -> set[str]:
    """What of the source goes into the image: files and folders at its top."""
    copies = [line.split() for line in (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
              if line.startswith("COPY ") and "--from" not in line]
    return {Path(source).parts[0] for copy in copies for source in copy[1:-1] if not source.startswith("--")}


def replace(file: Path, text: str) -> None:
    """Write a file as most editors do: a new one takes the place of the old one."""
    new = file.with_suffix(".new")
    new.write_text(text, encoding="utf-8")
    new.replace(file)


def test_service_follows_its_source(cell):
    own, shared = cell.folder / "services" / "vision_detector.py", cell.folder / "common" / "clock.py"
    router, other, first = (cell.process(service) for service in ("router", OTHER, SERVICE))
    good = own.read_text(encoding="utf-8")

    def started_again(service: str, before: int) -> int:
        cell.wait_for(f"{service} is another process", lambda: cell.process(service) not in (0, before), PATIENCE)
        cell.wait_for(f"{service} is ready again", lambda: cell.is_ready(service), PATIENCE)
        return cell.process(service)

    replace(own, good + "# edited\n")
    second = started_again(SERVICE, first)
    assert (cell.process("router"), cell.process(OTHER)) == (router, other), "no other service restarts"

    replace(own, good + "def (\n")
    cell.wait_for("the service has ended", lambda: cell.process(SERVICE) == 0, PATIENCE)
    assert "SyntaxError" in cell.compose("logs", SERVICE)
    assert not cell.is_ready(SERVICE)
    state = cell.inspect(SERVICE)["State"]
    assert state["Running"], "the container waits for the next edit"

    replace(own, good)
    third = started_again(SERVICE, second)
    assert cell.inspect(SERVICE)["State"]["StartedAt"] == state["StartedAt"], "the container is still the same"

    replace(shared, shared.read_text(encoding="utf-8") + "# edited\n")
    for service, before in (("router", router), (SERVICE, third), (OTHER, other)):
        started_again(service, before)
