"""The compose files and manifests are those that the cells give, and hold what they promise."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from common.config import load_cell, names_of
from deploy.generate import ROOT, generated
from deploy.watched import concerns, own_file

COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))
CELLS = names_of("cells")
MANIFESTS = [
    document
    for path, text in generated().items() if "kubernetes" in path.parts and path.name != "kustomization.yaml"
    for document in yaml.safe_load_all(text)
]
DEPLOYMENTS = [document for document in MANIFESTS if document["kind"] == "Deployment"]


@pytest.mark.parametrize("path", generated(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_file_is_what_the_cells_give(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == generated()[path], "run `make deploy`"


@pytest.mark.parametrize("cell", CELLS)
def test_each_service_of_a_cell_has_a_container_in_its_profile(cell: str) -> None:
    mine = {name: service for name, service in COMPOSE["services"].items() if cell in service["profiles"]}
    assert list(mine) == ["router", *(f"{cell}-{entry.name}" for entry in load_cell(cell).services.values())]
    for entry in load_cell(cell).services.values():
        assert mine[f"{cell}-{entry.name}"]["command"][:3] == ["python", "-m", entry.module]


@pytest.mark.parametrize("name", COMPOSE["services"])
def test_container_is_locked_down(name: str) -> None:
    service = COMPOSE["services"][name]
    assert service["read_only"] and service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["mem_limit"] and service["restart"] == "unless-stopped"
    assert service["init"], "the health check cannot kill a service that is the container's first process"
    assert "./config:/app/config:ro" in service["volumes"]


def test_page_of_a_pod_listens_within_it_only() -> None:
    for file in (ROOT / "deploy" / "kubernetes").rglob("*.yaml"):
        assert "viewer.host" not in file.read_text() and "viewer.published" not in file.read_text()


def test_only_the_page_is_published_and_only_to_this_machine() -> None:
    published = {name: service["ports"] for name, service in COMPOSE["services"].items() if "ports" in service}
    assert set(published) == {f"{cell}-viewer" for cell in CELLS}
    assert all(port.startswith("127.0.0.1:") for ports in published.values() for port in ports)
    assert COMPOSE["networks"]["cell"]["internal"]


@pytest.mark.parametrize("cell", CELLS)
def test_task_starts_when_everybody_else_is_ready(cell: str) -> None:
    task = COMPOSE["services"][f"{cell}-{load_cell(cell).task}"]
    others = {name for name, s in COMPOSE["services"].items() if cell in s["profiles"] and s is not task}
    assert set(task["depends_on"]) == others
    assert {wait["condition"] for wait in task["depends_on"].values()} == {"service_healthy"}


@pytest.mark.parametrize(("path", "wanted"), [
    ("/app/services/viewer.py", True), ("/app/services/router.py", False), ("/app/common/sim/world.py", True),
    ("/app/services/viewer.py~", False), ("/app/common/README.md", False),
])
def test_service_is_started_again_for_its_own_file_and_for_what_all_share(path: str, wanted: bool) -> None:
    services = yaml.safe_load((ROOT / "compose.dev.yaml").read_text(encoding="utf-8"))["services"]
    assert concerns("modified", path, own_file(services["ur5-viewer"]["command"])) is wanted


@pytest.mark.parametrize("document", MANIFESTS, ids=lambda d: f"{d['kind']} {d['metadata']['name']}")
def test_manifest_is_valid(document: dict[str, Any]) -> None:
    kubernetes_validate.validate(document, "1.31", strict=True)


def test_validator_refuses_a_manifest_with_a_field_that_is_none() -> None:
    broken = DEPLOYMENTS[0] | {"spec": DEPLOYMENTS[0]["spec"] | {"replica": 1}}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(broken, "1.31", strict=True)


def test_kustomizations_name_files_that_are_there() -> None:
    for path, text in generated().items():
        if path.name == "kustomization.yaml":
            for resource in yaml.safe_load(text)["resources"]:
                found = path.parent / resource
                assert found.is_file() or (found / "kustomization.yaml").is_file(), found


@pytest.mark.parametrize("deployment", DEPLOYMENTS, ids=lambda d: d["metadata"]["name"])
def test_pod_runs_once_without_rights(deployment: dict[str, Any]) -> None:
    spec = deployment["spec"]
    assert spec["replicas"] == 1 and spec["strategy"] == {"type": "Recreate"}
    pod = spec["template"]["spec"]
    assert pod["securityContext"]["runAsNonRoot"] and not pod["automountServiceAccountToken"]
    [container] = pod["containers"]
    assert container["securityContext"]["readOnlyRootFilesystem"]
    assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
    assert container["resources"]["limits"]["memory"]


def test_devcontainer_names_its_extensions() -> None:
    text = (ROOT / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8")
    parsed = json.loads("\n".join(line for line in text.splitlines() if not line.strip().startswith("//")))
    assert "ms-python.python" in parsed["customizations"]["vscode"]["extensions"]
    assert parsed["postCreateCommand"] == "make setup"
    assert (ROOT / ".devcontainer" / parsed["build"]["dockerfile"]).is_file()
