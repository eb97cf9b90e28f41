"""The compose files and manifests are those of the cells, and restrict their containers."""

import json
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from common.config import load_cell, names_of
from deploy.generate import ROOT, generated
from deploy.watched import concerns, own_file

CELLS = names_of("cells")


@pytest.fixture(scope="module")
def files() -> dict[Path, str]:
    return generated()


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))


def test_files_are_up_to_date(files):
    outdated = [path for path, text in files.items() if path.read_text(encoding="utf-8") != text]
    assert not outdated, "run `make deploy`"


@pytest.mark.parametrize("name", CELLS)
def test_each_service_has_a_container_and_the_task_starts_last(name, compose):
    cell, mine = load_cell(name), {key: each for key, each in compose["services"].items() if name in each["profiles"]}
    assert list(mine) == ["router", *(f"{name}-{entry.name}" for entry in cell.services.values())]
    for entry in cell.services.values():
        assert mine[f"{name}-{entry.name}"]["command"][:3] == ["python", "-m", entry.module]
    task = mine.pop(f"{name}-{cell.task}")
    assert set(task["depends_on"]) == set(mine)
    assert {wait["condition"] for wait in task["depends_on"].values()} == {"service_healthy"}


def test_containers_are_locked_down(compose):
    for name, service in compose["services"].items():
        assert service["read_only"] and service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert service["mem_limit"] and service["restart"] == "unless-stopped", name
        assert service["init"], "the health check cannot kill a service that is the container's first process"
        assert "./config:/app/config:ro" in service["volumes"], name


def test_only_the_page_is_published_and_only_to_this_machine(compose):
    published = {name: service["ports"] for name, service in compose["services"].items() if "ports" in service}
    assert set(published) == {f"{cell}-{name}" for cell in CELLS for name, each in load_cell(cell).services.items()
                              if each.kind == "viewer"}
    assert all(port.startswith("127.0.0.1:") for ports in published.values() for port in ports)
    assert compose["networks"]["cell"]["internal"]
    for file in (ROOT / "deploy" / "kubernetes").rglob("*.yaml"):  # the page of a pod listens within it only
        assert "viewer.host" not in file.read_text() and "viewer.published" not in file.read_text()


@pytest.mark.parametrize(("path", "wanted"), [
    ("/app/services/viewer.py", True), ("/app/services/router.py", False), ("/app/common/sim/world.py", True),
    ("/app/services/viewer.py~", False), ("/app/common/README.md", False),
])
def test_service_restarts_for_its_own_file_and_shared_ones(path, wanted):
    services = yaml.safe_load((ROOT / "compose.dev.yaml").read_text(encoding="utf-8"))["services"]
    assert concerns("modified", path, own_file(services["ur5-viewer"]["command"])) is wanted


def test_manifests_are_valid_and_pods_run_once_without_rights(files):
    manifests = [document for path, text in files.items()
                 if "kubernetes" in path.parts and path.name != "kustomization.yaml"
                 for document in yaml.safe_load_all(text)]
    deployments = [document for document in manifests if document["kind"] == "Deployment"]
    for document in manifests:
        kubernetes_validate.validate(document, "1.31", strict=True)
    broken = deployments[0] | {"spec": deployments[0]["spec"] | {"replica": 1}}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(broken, "1.31", strict=True)
    for deployment in deployments:
        spec = deployment["spec"]
        assert spec["replicas"] == 1 and spec["strategy"] == {"type": "Recreate"}
        pod = spec["template"]["spec"]
        assert pod["securityContext"]["runAsNonRoot"] and not pod["automountServiceAccountToken"]
        [container] = pod["containers"]
        assert container["securityContext"]["readOnlyRootFilesystem"]
        assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
        assert container["resources"]["limits"]["memory"]


def test_kustomizations_name_existing_files(files):
    for path, text in files.items():
        if path.name == "kustomization.yaml":
            for resource in yaml.safe_load(text)["resources"]:
                found = path.parent / resource
                assert found.is_file() or (found / "kustomization.yaml").is_file(), found


def test_devcontainer_is_set_up_like_a_development_machine():
    text = (ROOT / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8")
    parsed = json.loads("\n".join(line for line in text.splitlines() if not line.strip().startswith("//")))
    assert "ms-python.python" in parsed["customizations"]["vscode"]["extensions"]
    assert parsed["postCreateCommand"] == "make setup"
    assert (ROOT / ".devcontainer" / parsed["build"]["dockerfile"]).is_file()
