"""Examples of what newcomers wrote at first: a program that tends a machine, odd parts, two arms, a raw client."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from applications.programming.files import load_program
from applications.programming.offline import overrides_for
from applications.programming.topics import PROGRAM_COMMAND, PROGRAM_STATUS, ProgramCommand
from common.client.blocking import Cell
from common.config import load_cell
from common.transport.bus import Bus
from lab.simulation import Simulation
from tests.domains import free_domain
from tests.harness import ask

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SMALL = ["services.depth_camera.rate=1.0", "world.camera.width=320", "world.camera.height=240", "world.camera.fx=400",
         "world.camera.fy=400", "world.camera.cx=160", "world.camera.cy=120"]

pytestmark = [pytest.mark.slow, pytest.mark.timeout(240)]


def run(*arguments: str | Path) -> str:
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0 and not done.stderr, done.stderr
    return done.stdout


def test_program_tends_the_machine_and_fills_the_pallet() -> None:
    own, _ = overrides_for(load_program(EXAMPLES / "programs" / "tend.yaml"), "tending")
    states: list[str] = []

    async def visit(bus: Bus) -> None:
        await bus.client(PROGRAM_COMMAND).call(ProgramCommand(command="run", program="tend"), 30.0)
        async for status in bus.reader(PROGRAM_STATUS):
            states.append(status.state)
            if status.state in ("DONE", "ERROR"):
                return

    simulation = Simulation(load_cell("tending", [*own, *SMALL], seed=2), 2, visit=visit)
    outcome = simulation.run()
    assert (outcome.state, outcome.crashes, states[-1]) == ("DONE", [], "DONE"), outcome


@pytest.mark.campaign
@pytest.mark.alone
def test_odd_parts_are_lifted_in_physics() -> None:
    lines = run(EXAMPLES / "odd_parts" / "grip.py").splitlines()
    found = [re.fullmatch(r"(\w+): grasped, (\d+\.\d) mm wide, lifted to 0\.2\d\d m", line) for line in lines]
    widths = [(one[1], round(float(one[2]))) for one in found if one]
    assert widths == [("hammer", 23), ("ring", 59), ("ell", 29)], lines


def test_client_without_zencell_reads_joints_and_commands_the_gripper() -> None:
    domain = free_domain()
    with Cell.start("panda", overrides=["world.count=0"], domain=domain):
        joints, accepted, refused = run(
            EXAMPLES / "wire" / "raw_client.py", "panda", f"tcp/127.0.0.1:{7447 + domain}").splitlines()
    assert joints.startswith("joints [") and "'raw-1'" in accepted and "'state': 'active'" in accepted
    assert "'code': 'invalid'" in refused and "GripperCommand" in refused


def test_two_arms_are_a_cell_without_errors(tmp_path: Path) -> None:
    done: Any = ask(tmp_path, "check", str(EXAMPLES / "two_arms.yaml"))
    assert (done.returncode, done.stdout.strip().splitlines()[-1]) == (0, "two_arms: no errors, no warnings")
