"""Programs in a cell of real processes: exported as a script, and resumed after the supervisor was killed."""

from __future__ import annotations

import asyncio
import sys
from contextlib import AbstractAsyncContextManager, suppress
from pathlib import Path
from subprocess import run
from typing import Any

import psutil
import pytest

from applications.programming.topics import PROGRAM_COMMAND, PROGRAM_STATUS, ProgramCommand, ProgramStatus
from common import topics
from common.transport.bus import Bus
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect
from tests.harness import PATIENCE, Place, Zencell, ask, environment, free_domain, until

pytestmark = [pytest.mark.cell, pytest.mark.timeout(300)]

CELL = Path(__file__).parents[1] / "data" / "programs.yaml"
BOTH = """\
cell: {cell}
steps:
  - {{step: grip, width: 0.05}}
  - {{step: approach, to: {{position: [0.5, 0.1, 0.4]}}, distance: 0.1, axis: world}}
  - step: loop
    count: 2
    steps: [{{step: move, to: {{by: [0, -0.05, 0.02]}}, straight: true}}]
  - {{step: output, signal: clamp}}
  - {{step: wait, for: {{signal: clamp_closed}}}}
  - step: if
    when: {{signal: clamp_closed}}
    then: [{{step: retreat, distance: 0.05}}]
    else: [{{step: move, to: home}}]
"""


def connected(place: Place) -> AbstractAsyncContextManager[Bus]:
    return connect(cell="programs", service="watcher", endpoint=endpoint_of(place.domain), timeout=PATIENCE)


async def end_state(bus: Bus) -> tuple[list[float], float, dict[str, object]]:
    """Joint positions [rad], width of the fingers [m] and signals, at standstill."""
    joints, gripper = bus.reader(topics.JOINT_STATES), bus.reader(topics.GRIPPER_STATE)
    io = bus.reader(topics.IO_STATE)
    state = await joints.next()
    signals = {each.name: each.value for each in (io.latest or await io.next()).signals}
    return list(state.position), (gripper.latest or await gripper.next()).width, signals


@pytest.mark.slow
async def test_exported_script_ends_in_the_same_state_as_the_program(tmp_path: Path) -> None:
    program = tmp_path / "both.yaml"
    program.write_text(BOTH.format(cell=CELL))
    place = Place(tmp_path, free_domain())
    script = tmp_path / "both.py"
    script.write_text(ask(tmp_path, "program", "export", str(program)).stdout)
    command = place.start("up", str(program), "--no-viewer", "--speed", "5")
    try:
        async with connected(place) as bus:
            command.until("zenoh --mode client")
            statuses, send = bus.reader(PROGRAM_STATUS), bus.client(PROGRAM_COMMAND)
            await send.call(ProgramCommand(command="run"), PATIENCE)
            ended = await until(statuses, lambda status: status.state in ("DONE", "ERROR"))
            assert ended.state == "DONE", ended.message
            first = await end_state(bus)
            (tmp_path / "back.yaml").write_text(
                "steps:\n  - {step: output, signal: clamp, value: false}\n  - {step: move, to: home}\n"
                "  - {step: grip, width: open}\n")
            await send.call(ProgramCommand(command="run", program="back"), PATIENCE)
            await until(statuses, lambda status: status.program == "back" and status.state == "DONE")
            assert max(abs(a - b) for a, b in zip((await end_state(bus))[0], first[0], strict=True)) > 0.1
            variables = environment(tmp_path) | {"ZENCELL_DOMAIN": str(place.domain)}
            done = await asyncio.to_thread(
                run, [sys.executable, script, "programs"], capture_output=True, text=True, env=variables, check=False)
            assert (done.returncode, done.stderr) == (0, "")
            second = await end_state(bus)
    finally:
        place.end()
    assert second[0] == pytest.approx(first[0], abs=0.01)
    assert (second[1], second[2]) == (pytest.approx(first[1], abs=1e-3), first[2])


SLOW = """\
cell: {cell}
steps:
  - {{step: move, id: away, to: {{position: [0.4, 0.0, 0.5]}}}}
  - {{step: move, id: down, to: {{by: [0, 0, -0.2]}}, straight: true, speed: 0.02}}
"""


@pytest.mark.slow
async def test_program_of_a_killed_supervisor_is_resumed_only_on_request_and_forgotten_after_ctrl_c(
    tmp_path: Path,
) -> None:
    program = tmp_path / "slow.yaml"
    program.write_text(SLOW.format(cell=CELL))
    place = Place(tmp_path, free_domain())
    run_it = ("run", str(program), "--no-viewer", "--speed", "2")
    command = place.start(*run_it)
    try:
        async with connected(place) as bus:
            await until(bus.reader(PROGRAM_STATUS), lambda status: status.step == "down")
            await until(bus.reader(topics.MOTION_STATUS), lambda m: m.state == "active" and 0.1 < m.progress < 0.9)
        kill_supervisor(command)
        command = place.start(*run_it)
        async with connected(place) as bus:
            statuses: Any = bus.reader(PROGRAM_STATUS)
            halted: ProgramStatus = await until(statuses, lambda status: bool(status.halted))
            assert "slow was interrupted at step down" in halted.halted
            command.until("slow was interrupted at step down")
            motion = bus.reader(topics.MOTION_STATUS)
            await bus.client(PROGRAM_COMMAND).call(ProgramCommand(command="breakpoint", step="away"), PATIENCE)
            await until(statuses, lambda status: status.breakpoints == ["away"])  # it runs, and still halts
            assert (motion.latest or await motion.next()).state == "none"
            assert (await asyncio.to_thread(place.say, "program", "resume")) == [
                "slow: step down (line 4); breakpoints: away"]
            await until(motion, lambda m: m.state == "active" and m.progress > 0.1)
            command.interrupt()
        assert command.end() == 130
        command = place.start(*run_it)
        async with connected(place) as bus:
            await until(bus.reader(PROGRAM_STATUS), lambda status: status.step == "away" and status.state == "RUNNING")
    finally:
        place.end()


def kill_supervisor(command: Zencell) -> None:
    """Kill the supervisor; its processes end by themselves."""
    with suppress(psutil.NoSuchProcess):
        psutil.Process(command.process.pid).kill()
    command.end()
    command.until_childless()
