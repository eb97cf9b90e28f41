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
from tests.security.raw_client import TIMEOUT, RawClient

pytestmark = [pytest.mark.cell, pytest.mark.slow, pytest.mark.timeout(300)]

EYE = ["camera_simulator", "vision_detector", "workspace_validator"]
ARM = [entry.name for entry in load_cell("panda").services.values() if entry.name not in (*EYE, "viewer")]


def install(host: Path, certificates: Path, services: Iterable[str]) -> Path:
    """Copy the certificates of one host; return their folder."""
    folder = host / "certs"
    folder.mkdir(parents=True)
    for name in ("router", *(f"panda.{process}" for process in ("supervisor", *services))):
        for kind in ("pem", "key"):
            shutil.copy(certificates / f"{name}.{kind}", folder)
    for name in ("ca.pem", "access.json5"):
        shutil.copy(certificates / name, folder)
    return folder


def test_run_completes_with_perception_and_arm_behind_different_routers(certificates: Path, tmp_path: Path) -> None:
    hosts = tmp_path / "eye", tmp_path / "arm"
    secured = [install(host, certificates, part) for host, part in zip(hosts, (EYE, ARM), strict=True)]
    same = ("--speed", "5", "--set", "world.count=1")
    epoch = {"ZENCELL_EPOCH": str(time.time_ns())}
    with RunningCell(
        hosts[0], "up", "panda", "--only", ",".join(EYE), "--secure", str(secured[0]), *same, secrets=epoch
    ) as eye:
        reached = f"tls/127.0.0.1:{port_of(eye.domain)}"
        with (RawClient(reached, credentials_of("operator", certificates)) as operator,
              RawClient(reached, credentials_of("panda.camera_simulator", certificates)) as camera,
              RunningCell(hosts[1], "run", "panda", "--without", ",".join(EYE), "--secure", str(secured[1]),
                          "--link", reached, *same, secrets=epoch) as arm):
            received = operator.subscribe("panda/joint_states", "panda/detected_objects")
            while not operator.query("panda/motion/status", timeout=TIMEOUT):  # by the arm, over the link
                before = len(received.samples)
                received.wait(lambda samples, seen=before: len(samples) > seen)  # type: ignore[misc]
            assert camera.query("panda/motion/status", timeout=1.0) == []
            assert asyncio.run(arm.ended(240)) == 0, f"{arm.tail()}\nand the eye:\n{eye.tail()}"
        assert arm.summary["state"] == "DONE"
        assert arm.summary["truth"] == {"in_box": 1, "on_table": 0, "elsewhere": 0, "containers": {"box": 1}}
        eye.interrupt()
        assert asyncio.run(eye.ended(60)) == 0
    assert "panda/detected_objects" in received.keys
