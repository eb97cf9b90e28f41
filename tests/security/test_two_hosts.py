"""A secured cell on two hosts with linked routers; each host has only the certificates that it needs."""

import asyncio
import shutil
import time
from collections.abc import Iterable
from pathlib import Path

import pytest

from common.config import load_cell
from common.transport.credentials import credentials_of
from common.transport.endpoint import port_of
from tests.harness import RunningCell
from tests.security.raw_client import TIMEOUT, RawClient, Received

pytestmark = [pytest.mark.cell, pytest.mark.slow, pytest.mark.timeout(300)]

EYE = ["camera_simulator", "vision_detector", "workspace_validator"]
ARM = [entry.name for entry in load_cell("panda").services.values() if entry.name not in (*EYE, "viewer")]


def install(host: Path, certificates: Path, services: Iterable[str]) -> Path:
    """Copy the certificates of one host; return its folder."""
    host.mkdir()
    for name in ("router", *(f"panda.{process}" for process in ("supervisor", *services))):
        for kind in ("pem", "key"):
            shutil.copy(certificates / f"{name}.{kind}", host)
    for name in ("ca.pem", "access.json5"):
        shutil.copy(certificates / name, host)
    return host


def wait_answered(client: RawClient, key: str, received: Received) -> None:
    """Query a key until there is a reply, again after each received sample."""
    while not client.query(key, timeout=TIMEOUT):
        before = len(received.samples)
        received.wait(lambda samples, seen=before: len(samples) > seen)  # type: ignore[misc]


def test_run_completes_with_perception_and_arm_behind_different_routers(certificates: Path, tmp_path: Path) -> None:
    folders = [tmp_path / "eye", tmp_path / "arm"]
    for folder in folders:
        folder.mkdir()
    secured = [install(folder / "certs", certificates, part) for folder, part in zip(folders, (EYE, ARM), strict=True)]
    same = ("--speed", "5", "--set", "world.count=1")
    epoch = {"ZENCELL_EPOCH": str(time.time_ns())}
    with RunningCell(
        folders[0], "up", "panda", "--only", ",".join(EYE), "--secure", str(secured[0]), *same, secrets=epoch
    ) as eye:
        reached = f"tls/127.0.0.1:{port_of(eye.domain)}"
        with (
            RawClient(reached, credentials_of("operator", certificates)) as operator,
            RawClient(reached, credentials_of("panda.camera_simulator", certificates)) as camera,
        ):
            received = operator.subscribe("panda/joint_states", "panda/detected_objects")
            with RunningCell(
                folders[1], "run", "panda", "--without", ",".join(EYE), "--secure", str(secured[1]), "--link", reached,
                *same, secrets=epoch,
            ) as arm:
                wait_answered(operator, "panda/motion/status", received)  # by the arm, over the link
                assert camera.query("panda/motion/status", timeout=1.0) == []
                assert asyncio.run(arm.ended(240)) == 0, f"{arm.tail()}\nand the eye:\n{eye.tail()}"
        assert arm.summary["state"] == "DONE"
        assert arm.summary["truth"] == {"in_box": 1, "on_table": 0, "elsewhere": 0, "containers": {"box": 1}}
        eye.interrupt()
        assert asyncio.run(eye.ended(60)) == 0
    assert "panda/detected_objects" in received.keys
