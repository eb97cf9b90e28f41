"""Complete cells that move an arm by its maker's protocol: the controller is a double, the client library is not."""

import asyncio
import importlib.util
import os
from pathlib import Path

import pytest

from common import topics
from common.messages import MotionStatus, RobotCommand, RobotStatus
from common.transport.bus import Bus
from tests.doubles.franka_host import PYTHON as FRANKA_SIM
from tests.doubles.franka_host import FrankaHost
from tests.doubles.ur_host import UrHost
from tests.harness import RunningCell, until

pytestmark = [pytest.mark.cell, pytest.mark.campaign, pytest.mark.alone, pytest.mark.timeout(300)]


def missing(module: str) -> bool:
    """Whether a module cannot be imported; under CI its import fails instead."""
    return os.environ.get("CI") != "true" and importlib.util.find_spec(module) is None


on_ur = pytest.mark.skipif(missing("rtde_control"), reason="make setup EXTRAS=ur")
on_franka = pytest.mark.skipif(not FRANKA_SIM.exists() or missing("pylibfranka"),
                               reason="make franka-sim setup EXTRAS=franka")

HOME = "0,-2.36,1.57,-1.57,-1.57,0"
SOON, WHOLE = 30.0, 150.0  # [s] for reactions of a link or controller; for a complete outline
STANDSTILL = 2_000_000_000  # [ns] without a change of position
PULLED = float(os.environ.get("ZENCELL_TEST_PULLED", "10"))  # [s] without cable


def outliner(folder: Path, host: UrHost) -> RunningCell:
    """Start the UR5 cell with that arm."""
    return RunningCell(
        folder, "run", "ur5", "--set", "robot.hardware.backend=ur",
        "--set", f"robot.hardware.options.host={host.host}", "--set", "robot.hardware.options.model=ur5e",
        "--set", "robot.hardware.options.world=simulated", "--set", "robot.hardware.options.ahead=0.2",
    )


def check_traced(cell: RunningCell, host: UrHost, stops: int = 0) -> None:
    """Check that the outline is complete and that only the test caused protective stops."""
    summary = cell.summary
    assert summary["state"] == "DONE" and summary["failures"] == 0, cell.text
    assert summary["outline"]["fraction"] > 0.99, summary["outline"]
    assert host.command()["stops"] == stops, cell.tail()


@on_ur
async def test_outline_survives_a_protective_stop_a_pulled_cable_and_a_controller_reboot(tmp_path: Path) -> None:
    with UrHost("127.0.0.51", q=HOME) as host, outliner(tmp_path, host) as cell:
        async with cell.listen() as bus:
            robot, motion = bus.reader(topics.ROBOT_STATUS), bus.reader(topics.MOTION_STATUS)
            order = bus.client(topics.ROBOT_COMMAND)

            async def moving() -> None:
                await until(motion, lambda status: status.state == "active" and status.progress > 0.2, WHOLE)

            await moving()
            host.command("protect")
            reported: RobotStatus = await until(robot, lambda status: status.mode == "protective_stop", SOON)
            assert "recover" in reported.message
            failed: MotionStatus = await until(motion, lambda status: bool(status.fault), SOON)
            assert failed.state == "aborted" and failed.error == "hardware_fault"
            before = host.command("normal")  # the pendant alone releases nothing
            await until(robot, lambda status: "was stopped" in status.message, SOON)
            now = host.command()
            assert now["commands"] == before["commands"] and not any(now["qd"])
            await order.call(RobotCommand(act="recover", owner="tester"), SOON)
            for pulled in (1.0, PULLED):
                await moving()
                host.command(f"pull {pulled}")
                await until(robot, lambda status: status.mode == "disconnected", SOON)
                await until(robot, lambda status: status.mode == "running", pulled + SOON)
            await moving()
            host.command("reboot 2")
            await until(robot, lambda status: status.mode == "off", SOON)
            before = host.command()
            await until(motion, lambda status: "without power" in status.fault, SOON)
            now = host.command()
            assert (now["commands"], now["q"]) == (before["commands"], before["q"]) and now["mode"] == "POWER_OFF"
            await order.call(RobotCommand(act="enable", owner="tester"), SOON)
            assert await cell.ended(WHOLE) == 0, cell.tail()
        check_traced(cell, host, stops=1)
    assert "tester orders the arm: recover" in cell.text


@on_ur
async def test_outline_is_traced_at_thirty_percent_of_the_speed_slider(tmp_path: Path) -> None:
    with UrHost("127.0.0.53", q=HOME) as host, outliner(tmp_path, host) as cell:
        host.command("slider 0.3")
        async with cell.listen() as bus:
            motion = bus.reader(topics.MOTION_STATUS)
            status = await until(motion, lambda status: status.state == "active" and status.progress > 0.2, WHOLE)
            assert status.speed_scaling == pytest.approx(0.3)
            for arguments, output in (
                (("io",), "inputs on: none\noutputs on: none"),
                (("io", "3", "up"), "zencell: io: 'up' must be on or off"),
                (("io", "99", "on"), "zencell: output.output: 99 must be less than 32"),
            ):
                answer = await asyncio.to_thread(cell.command, "robot", *arguments)
                assert (answer.stdout + answer.stderr).strip() == output
            assert await cell.ended(WHOLE + SOON) == 0, cell.tail()
        check_traced(cell, host)
        assert host.command()["fastest"] <= 0.3 * 3.14159 * 1.05


async def standstill(bus: Bus, host: FrankaHost) -> list[float]:
    """Return the position of the arm [rad] once it has not changed for some time, by the stamps of joint states."""
    joints = bus.reader(topics.JOINT_STATES)
    since, position = (await joints.next()).header.stamp, host.positions
    async with asyncio.timeout(SOON):
        async for state in joints:
            if host.positions != pytest.approx(position, abs=1e-3):
                since, position = state.header.stamp, host.positions
            elif state.header.stamp > since + STANDSTILL:
                break
    return position


def picker(folder: Path) -> RunningCell:
    """Start the Panda cell with a Franka Research 3."""
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
            stopped_at = await standstill(bus, host)
            assert await standstill(bus, host) == pytest.approx(stopped_at, abs=1e-3), "no motion was requested"
            await bus.client(topics.ROBOT_COMMAND).call(RobotCommand(act="recover", owner="tester"), SOON)
            for silent in (1.0, PULLED):
                await under_way()
                await asyncio.to_thread(host.freeze, silent)
                await until(robot, lambda status: status.mode == "disconnected", SOON)
            await under_way()
            host.crash()
            await until(robot, lambda status: status.mode == "disconnected", SOON)
            stopped_at = host.positions
            await asyncio.to_thread(host.boot)
            await until(robot, lambda status: status.mode == "running", SOON)
            assert host.positions == pytest.approx(stopped_at, abs=0.05), "it resumed from where it stopped"
            assert await cell.ended(2 * WHOLE) == 0, cell.tail()
    summary = cell.summary
    assert summary["state"] == "DONE" and summary["failures"] == 0, cell.text
    assert summary["placed"] == summary["truth"]["in_box"] == 7, summary
    assert "tester orders the arm: recover" in cell.text
