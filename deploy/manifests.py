"""Kubernetes manifests of the cells: a Deployment for each service, one router, and who may talk to whom."""

from __future__ import annotations

from typing import Any

import yaml

from common.atomic_file import STATE_VARIABLE
from deploy.containers import (
    DATA,
    IMAGE,
    ROUTER,
    ROUTER_PORT,
    USER,
    VIEWER_PORT,
    Container,
    cells,
    containers_of,
    router,
)

HEAD = "# Made by `make deploy` from config/cells: change those, or put an overlay on it.\n"
PART_OF = {"app.kubernetes.io/part-of": "zencell"}
# A service that is frozen or cut off loses its readiness token within the lease of 2 s, and is then restarted.
CHECK = {"exec": {"command": ["python", "-m", "common.process.health"]}, "timeoutSeconds": 3}
CPU_OF_A_SERVICE = "100m"


def manifests() -> dict[str, str]:
    """The text of each file, by its path: a folder for the router, and one for each cell, which needs the router."""
    shared = [_deployment(ROUTER, ROUTER, router(), port=ROUTER_PORT), _service(ROUTER, ROUTER_PORT), *_network()]
    folders = {ROUTER: (shared, [f"{ROUTER}.yaml"])}
    for file, cell in cells().items():
        made = [
            _deployment(f"{file}-{container.name}".replace("_", "-"), file, container,
                        port=VIEWER_PORT if container.page else None)
            for container in containers_of(file, cell)
        ]
        made += _claims(file, containers_of(file, cell))
        folders[file] = (made, [f"../{ROUTER}", f"{file}.yaml"])
    texts = {}
    for folder, (made, resources) in folders.items():
        kustomization = {
            "apiVersion": "kustomize.config.k8s.io/v1beta1", "kind": "Kustomization", "resources": resources,
        }
        texts[f"{folder}/{folder}.yaml"] = HEAD + yaml.dump_all(made, sort_keys=False)
        texts[f"{folder}/kustomization.yaml"] = HEAD + yaml.dump(kustomization, sort_keys=False)
    return texts


def _labels(name: str, cell: str) -> dict[str, str]:
    return {**PART_OF, "app.kubernetes.io/name": name, "app.kubernetes.io/instance": cell}


def _deployment(name: str, cell: str, container: Container, port: int | None) -> dict[str, Any]:
    """One pod of the service, never two: a second executor or task would fight with the first."""
    labels = _labels(name, cell)
    environment = [{"name": key, "value": value} for key, value in container.environment.items()]
    main: dict[str, Any] = {
        "name": container.name.replace("_", "-"),
        "image": IMAGE,
        "command": container.command,  # a page listens within its pod only, where kubectl forwards from
        "env": environment,
        "resources": {
            "requests": {"cpu": CPU_OF_A_SERVICE, "memory": f"{container.memory // 2}Mi"},
            "limits": {"memory": f"{container.memory}Mi"},
        },
        "securityContext": {
            "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
        },
        "startupProbe": {**CHECK, "periodSeconds": 2, "failureThreshold": 60},
        "readinessProbe": {**CHECK, "periodSeconds": 5},
        "livenessProbe": {**CHECK, "periodSeconds": 5, "failureThreshold": 3},
        "volumeMounts": [{"name": "tmp", "mountPath": "/tmp"}, {"name": "data", "mountPath": DATA}],
    }
    if port is not None:
        main["ports"] = [{"containerPort": port}]
    pod = {
        "securityContext": {
            "runAsNonRoot": True, "runAsUser": USER, "fsGroup": USER, "seccompProfile": {"type": "RuntimeDefault"},
        },
        "automountServiceAccountToken": False,
        "terminationGracePeriodSeconds": 10,
        "containers": [main],
        "volumes": [{"name": "tmp", "emptyDir": {}}, {"name": "data", **_data(name, container)}],
    }
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": name, "labels": labels},
        "spec": {
            "replicas": 1,
            "strategy": {"type": "Recreate"},
            "selector": {"matchLabels": labels},
            "template": {"metadata": {"labels": labels}, "spec": pod},
        },
    }


def _data(name: str, container: Container) -> dict[str, Any]:
    """Where a pod keeps its data: what persons stopped or hold outlives the pod."""
    if STATE_VARIABLE not in container.environment:
        return {"emptyDir": {}}
    return {"persistentVolumeClaim": {"claimName": name}}


def _claims(file: str, containers: list[Container]) -> list[dict[str, Any]]:
    """The claims of the pods that keep something."""
    names = [f"{file}-{container.name}".replace("_", "-") for container in containers
             if STATE_VARIABLE in container.environment]
    return [
        {
            "apiVersion": "v1",
            "kind": "PersistentVolumeClaim",
            "metadata": {"name": name, "labels": _labels(name, file)},
            "spec": {"accessModes": ["ReadWriteOnce"], "resources": {"requests": {"storage": "64Mi"}}},
        }
        for name in names
    ]


def _service(name: str, port: int) -> dict[str, Any]:
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {"name": name, "labels": _labels(name, name)},
        "spec": {"selector": _labels(name, name), "ports": [{"port": port, "targetPort": port}]},
    }


def _network() -> list[dict[str, Any]]:
    """Nothing comes in but to the router, and there only from our own pods. A page is reached by port-forward."""
    ours = {"matchLabels": PART_OF}
    return [
        {
            "apiVersion": "networking.k8s.io/v1",
            "kind": "NetworkPolicy",
            "metadata": {"name": "nothing-comes-in", "labels": PART_OF},
            "spec": {"podSelector": ours, "policyTypes": ["Ingress"]},
        },
        {
            "apiVersion": "networking.k8s.io/v1",
            "kind": "NetworkPolicy",
            "metadata": {"name": "services-reach-the-router", "labels": PART_OF},
            "spec": {
                "podSelector": {"matchLabels": _labels(ROUTER, ROUTER)},
                "policyTypes": ["Ingress"],
                "ingress": [
                    {"from": [{"podSelector": ours}], "ports": [{"protocol": "TCP", "port": ROUTER_PORT}]}
                ],
            },
        },
    ]
