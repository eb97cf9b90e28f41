"""Whole cells that move an arm by its maker's protocol: the controller is a double, the client library is not."""

from __future__ import annotations

import asyncio
import importlib.util
import os
from pathlib import Path

import pytest

from common import topics
from common.messages import MotionStatus, RobotCommand, RobotStatus
from tests.doubles.franka_host import PYTHON as FRANKA_SIM
from tests.doubles.franka_host import FrankaHost
from tests.doubles.ur_host import UrHost
from tests.harness import RunningCell, until

pytestmark = [pytest.mark.cell, pytest.mark.campaign, pytest.mark.alone, pytest.mark.timeout(300)]


def missing(module: str) -> bool:
    """Whether that is not there; where it has to be that is found out when it is needed."""
    return os.environ.get("CI") != "true" and importlib.util.find_spec(module) is None


on_ur = pytest.mark.skipif(missing("rtde_control"), reason="make setup EXTRAS=ur")
on_franka = pytest.mark.skipif(not FRANKA_SIM.exists() or missing("pylibfranka"),
                               reason="make franka-sim setup EXTRAS=franka")

HOME = "0,-2.36,1.57,-1.57,-1.57,0"
SOON, WHOLE = 30.0, 150.0  # [s] for what a link or a controller does; for a whole outline
BRAKES = 2.0  # [s] in which an arm that has stopped for protection has come to rest
PULLED = float(os.environ.get("ZENCELL_TEST_PULLED", "10"))  # [s] that the cable is out: 60 was tried by hand


def outliner(folder: Path, host: UrHost) -> RunningCell:
    """The cell of the UR5, with that arm."""
    return RunningCell(
        folder, "run", "ur5", "--set", "robot.hardware.backend=ur",
        "--set", f"robot.hardware.options.host={host.host}", "--set", "robot.hardware.options.model=ur5e",
        "--set", "robot.hardware.options.world=simulated", "--set", "robot.hardware.options.ahead=0.2",
    )


def check_traced(cell: RunningCell, host: UrHost, stops: int = 0) -> None:
    """Nothing was lost, and the arm had no other reason to stop for protection than the test."""
    summary = cell.summary
    assert summary["state"] == "DONE" and summary["failures"] == 0, cell.text
    assert summary["outline"]["fraction"] > 0.99, summary["outline"]
    assert host.command()["stops"] == stops, cell.tail()


async def check_commands(cell: RunningCell) -> None:
    """Send commands to the arm's controller from a terminal while it moves."""
    for words, said in (
        (("io",), "inputs on: none\noutputs on: none"),
        (("io", "3", "up"), "zencell: io: 'up' must be on or off"),
        (("io", "99", "on"), "zencell: output.output: 99 must be less than 32"),
    ):
        done = await asyncio.to_thread(cell.command, "robot", *words)
        assert (done.stdout + done.stderr).strip() == said


@on_ur
async def test_outline_survives_a_protective_stop_and_a_pulled_cable(tmp_path: Path) -> None:
    with UrHost("127.0.0.51", q=HOME) as host, outliner(tmp_path, host) as cell:
        async with cell.listen() as bus:
            robot, motion = bus.reader(topics.ROBOT_STATUS), bus.reader(topics.MOTION_STATUS)
            await until(motion, lambda status: status.progress > 0.2, WHOLE)
            host.command("protect")
            reported: RobotStatus = await until(robot, lambda status: status.mode == "protective_stop", SOON)
            assert "recover" in reported.message
            failed: MotionStatus = await until(motion, lambda status: bool(status.fault), SOON)
            assert failed.state == "aborted" and failed.error == "hardware_fault"
            before = host.command("normal")  # the pendant alone releases nothing
            await until(robot, lambda status: "was stopped" in status.message, SOON)
            now = host.command()
            assert now["commands"] == before["commands"] and not any(now["qd"])
            await bus.client(topics.ROBOT_COMMAND).call(RobotCommand(act="recover", owner="tester"), SOON)
            await until(motion, lambda status: status.state == "active" and status.progress > 0.2, WHOLE)
            host.command("pull 1")
            await until(robot, lambda status: status.mode == "disconnected", SOON)
            await until(robot, lambda status: status.mode == "running", SOON)
            assert await cell.ended(WHOLE) == 0, cell.tail()
        check_traced(cell, host, stops=1)
    assert "tester orders the arm: recover" in cell.text


@on_ur
async def test_outline_survives_a_long_disconnection_and_a_controller_reboot(tmp_path: Path) -> None:
    with UrHost("127.0.0.52", q=HOME) as host, outliner(tmp_path, host) as cell:
        async with cell.listen() as bus:
            robot, motion = bus.reader(topics.ROBOT_STATUS), bus.reader(topics.MOTION_STATUS)
            await until(motion, lambda status: status.progress > 0.2, WHOLE)
            host.command(f"pull {PULLED}")
            await until(robot, lambda status: status.mode == "disconnected", SOON)
            await until(robot, lambda status: status.mode == "running", PULLED + SOON)
            await until(motion, lambda status: status.state == "active" and status.progress > 0.2, WHOLE)
            host.command("reboot 2")
            await until(robot, lambda status: status.mode == "off", SOON)
            before = host.command()
            await until(motion, lambda status: "without power" in status.fault, SOON)
            now = host.command()
            assert (now["commands"], now["q"]) == (before["commands"], before["q"]) and now["mode"] == "POWER_OFF"
            await bus.client(topics.ROBOT_COMMAND).call(RobotCommand(act="enable", owner="tester"), SOON)
            assert await cell.ended(WHOLE) == 0, cell.tail()
        check_traced(cell, host)


@on_ur
async def test_outline_is_traced_at_thirty_percent_of_the_speed_slider(tmp_path: Path) -> None:
    with UrHost("127.0.0.53", q=HOME) as host, outliner(tmp_path, host) as cell:
        host.command("slider 0.3")
        async with cell.listen() as bus:
            motion = bus.reader(topics.MOTION_STATUS)
            await until(motion, lambda status: status.state == "active" and status.progress > 0.2, WHOLE)
            assert motion.latest is not None and motion.latest.speed_scaling == pytest.approx(0.3)
            await check_commands(cell)
            assert await cell.ended(WHOLE + SOON) == 0, cell.tail()
        check_traced(cell, host)
        assert host.command()["fastest"] <= 0.3 * 3.14159 * 1.05


def picker(folder: Path) -> RunningCell:
    """The cell of the Panda, with a Franka Research 3."""
    values = ["robot=fr3", "robot.hardware.backend=franka", "robot.hardware.options={host: 127.0.0.1, ahead: 0.3, "
              "world: simulated}", "motion.velocity_scaling=0.4", "motion.acceleration_scaling=0.4"]
    return RunningCell(folder, "run", "panda", *(word for value in values for word in ("--set", value)))


@on_franka
@pytest.mark.timeout(600)
async def test_balls_are_placed_despite_a_reflex_silences_and_a_controller_restart(tmp_path: Path) -> None:
    with FrankaHost() as host, picker(tmp_path) as cell:
        async with cell.listen() as bus:
            robot, motion = bus.reader(topics.ROBOT_STATUS), bus.reader(topics.MOTION_STATUS)

            async def under_way() -> None:
                await until(robot, lambda status: status.mode == "running", SOON)
                await until(motion, lambda status: status.state == "active" and 0.2 < status.progress < 0.6, WHOLE)

            await under_way()
            host.hit()
            reported: RobotStatus = await until(robot, lambda status: status.mode == "protective_stop", SOON)
            assert "cartesian reflex" in reported.message and "recover" in reported.message
            failed: MotionStatus = await until(motion, lambda status: bool(status.fault), SOON)
            assert failed.state == "aborted" and failed.error == "hardware_fault"
            await asyncio.sleep(BRAKES)
            stopped_at = host.stands
            await asyncio.sleep(2.0)
            assert host.stands == pytest.approx(stopped_at, abs=1e-3), "no motion was requested"
            await bus.client(topics.ROBOT_COMMAND).call(RobotCommand(act="recover", owner="tester"), SOON)
            for silent in (1.0, PULLED):
                await under_way()
                await asyncio.to_thread(host.freeze, silent)
                await until(robot, lambda status: status.mode == "disconnected", SOON)
            await under_way()
            host.crash()
            await until(robot, lambda status: status.mode == "disconnected", SOON)
            stopped_at = host.stands
            await asyncio.to_thread(host.boot)
            await until(robot, lambda status: status.mode == "running", SOON)
            assert host.stands == pytest.approx(stopped_at, abs=0.05), "it resumed from where it stopped"
            assert await cell.ended(2 * WHOLE) == 0, cell.tail()
    summary = cell.summary
    assert summary["state"] == "DONE" and summary["failures"] == 0, cell.text
    assert summary["placed"] == summary["truth"]["in_box"] == 7, summary
    assert "tester orders the arm: recover" in cell.text
