"""Start, inspect and remove the containers of a compose project in a test."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from deploy.generate import ROOT

HEALTH = ("python", "-m", "common.process.health")


def require_engine() -> None:
    """Skip the test without a container engine."""
    answers = shutil.which("docker") and subprocess.run(["docker", "info"], capture_output=True, check=False)
    if not answers or answers.returncode:
        pytest.skip("no container engine answers `docker info`")


def run(
    *command: str, timeout: float = 60, check: bool = True, folder: Path = ROOT,
    environment: Mapping[str, str] | None = None,
) -> str:
    done = subprocess.run(
        command, cwd=folder, env={**os.environ, **(environment or {})}, capture_output=True, text=True,
        timeout=timeout, check=False,
    )
    assert done.returncode == 0 or not check, f"{' '.join(command)}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


@cache
def build_image() -> None:
    """Build the image of all services, once."""
    run("docker", "compose", "-p", "zencell-test", "build", "router", timeout=800)


@dataclass
class Containers:
    """A compose project, removed completely at the end of a `with` block."""

    project: str
    files: Sequence[str] = ("compose.yaml",)
    folder: Path = ROOT  # of the files
    environment: Mapping[str, str] = field(default_factory=dict)

    def __enter__(self) -> Containers:
        return self

    def __exit__(self, *_: object) -> None:
        of_ours = ("--filter", f"label=com.docker.compose.project={self.project}", "-q")
        for _ in range(2):  # old engines keep the network of a restarted container for a while
            self.compose("down", "-v", "-t", "10", timeout=180, check=False)
            if not run("docker", "network", "ls", *of_ours):
                break
        assert run("docker", "ps", "-a", *of_ours) == ""

    def compose(self, *arguments: str, timeout: float = 60, check: bool = True) -> str:
        return run(*self._command(*arguments), timeout=timeout, check=check, folder=self.folder,
                   environment=self.environment)

    def refused(self, *arguments: str, timeout: float = 60) -> str:
        """Run a command that must fail, and return its stderr."""
        done = subprocess.run(
            self._command(*arguments), cwd=self.folder, env={**os.environ, **self.environment}, capture_output=True,
            text=True, timeout=timeout, check=False,
        )
        assert done.returncode, f"{' '.join(arguments)} did not fail: {done.stdout[-2000:]}"
        return done.stderr

    def inspect_all(self, *services: str) -> dict[str, dict[str, Any]]:
        """Return what the engine knows about the containers, by service."""
        containers = self.compose("ps", "-a", "-q", *services).split()
        found: list[dict[str, Any]] = json.loads(run("docker", "inspect", *containers))
        return {each["Config"]["Labels"]["com.docker.compose.service"]: each for each in found}

    def inspect(self, service: str) -> dict[str, Any]:
        return self.inspect_all(service)[service]

    def health(self, service: str) -> str:
        """Return the engine's health status: starting, healthy or unhealthy."""
        return str(self.inspect(service)["State"]["Health"]["Status"])

    def is_ready(self, service: str) -> bool:
        """Run the health check now; the engine runs it only every few seconds."""
        container = self.compose("ps", "-q", service).strip()
        return bool(container) and subprocess.run(
            ["docker", "exec", container, *HEALTH], capture_output=True, timeout=60, check=False,
        ).returncode == 0

    def process(self, service: str) -> int:
        """Return the host process id of the service, or 0."""
        container = self.compose("ps", "-q", service).strip()
        listed = run("docker", "top", container, "-eo", "pid,args", check=False).splitlines()[1:] if container else []
        found = [int(line.split()[0]) for line in listed if line.split()[1:4] == ["python", "-m", _module(service)]]
        return found[0] if found else 0

    def address(self, service: str) -> str:
        """Return the address in the cell's network, which the host reaches, too."""
        networks = self.inspect(service)["NetworkSettings"]["Networks"]
        return str(networks[f"{self.project}_cell"]["IPAddress"])

    def wait_for(self, what: str, seen: Callable[[], bool], seconds: float) -> None:
        """Poll a condition twice a second, because an engine reports no events from inside a container."""
        deadline = time.monotonic() + seconds
        while not seen():
            assert time.monotonic() < deadline, (
                f"{what}: not within {seconds:g} s\n{self.compose('logs', '--tail', '5', check=False)}"
            )
            time.sleep(0.5)

    def _command(self, *arguments: str) -> list[str]:
        chosen = [word for name in self.files for word in ("-f", name)]
        return ["docker", "compose", "-p", self.project, *chosen, *arguments]


def _module(service: str) -> str:
    return f"services.{service.partition('-')[2] or service}"
