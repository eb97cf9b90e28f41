"""The Panda cell with real processes: start, closed loop, figures, external clients, end."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from common import topics
from common.config import load_cell
from common.messages import JointState, SupervisorStatus
from tests.harness import RunningCell, command_line, environment, until

pytestmark = pytest.mark.cell

SERVICES = [name for name in load_cell("panda").services if name != "viewer"]
GONE = 8.0  # [s] after Ctrl-C
TOPICS = ("joint_states", "camera/image_raw", "camera/camera_info", "gripper/state", "tf", "planning_scene",
          "detected_objects", "validated_targets", "pick_place_status", "scene_balls", "supervisor/status")


def all_ready(status: SupervisorStatus) -> bool:
    return len(status.services) == 1 + len(SERVICES) and all(service.state == "ready" for service in status.services)


def largest_way(before: JointState, after: JointState) -> float:
    return max(abs(a - b) for a, b in zip(after.position, before.position, strict=True))


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCell]:
    """A cell at speed 1 whose task waits."""
    with RunningCell(tmp_path_factory.mktemp("up"), "up", "panda", "--set", "autostart=false") as cell:

        async def ready() -> None:
            async with cell.listen() as bus:
                await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready)

        asyncio.run(ready())
        yield cell


def test_every_process_runs_once(up: RunningCell) -> None:
    assert sorted(up.processes()) == sorted(["router", *SERVICES])


def test_printed_zenoh_cli_command_decodes_the_topics(up: RunningCell) -> None:
    printed = next(line for line in up.text.splitlines() if line.startswith("zenoh --mode client"))
    program, *arguments = shlex.split(printed)
    assert arguments == ["--mode", "client", "--connect", up.endpoint, "subscribe", "-k", "panda/**", "--decoder",
                         "msgpack", "--line", "{key} {value}"]
    tool = Path(sys.executable).with_name(program)
    reading = subprocess.Popen(
        [str(tool), *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    too_late = threading.Timer(30.0, reading.kill)
    too_late.start()
    wanted, seen, lines = {f"panda/{key}" for key in TOPICS}, {}, []
    assert reading.stdout is not None
    for line in reading.stdout:
        key, _, value = line.rstrip("\n").partition(" ")
        lines.append(line)
        seen[key] = value
        if wanted <= seen.keys():
            break
    too_late.cancel()
    reading.kill()
    reading.stdout.close()
    reading.wait()
    assert not wanted - seen.keys(), f"{len(lines)} lines, the last: {lines[-1:]}"
    for key in wanted - {"panda/camera/image_raw"}:
        assert isinstance(json.loads(seen[key]), dict), seen[key]
    assert "640" in seen["panda/camera/image_raw"] and "bgr8" in seen["panda/camera/image_raw"]
    assert len(seen["panda/camera/image_raw"]) < 400


@pytest.mark.slow
def test_camera_publishes_at_most_about_ten_images_a_second(up: RunningCell) -> None:
    answer = up.command("topic", "hz", "camera/image_raw", "--count", "3", "--json")
    assert answer.returncode == 0, answer.stderr
    last = json.loads(answer.stdout.splitlines()[-1])
    assert 1 < last["hz"] < 13  # fewer on a machine that is busy


async def test_terminal_jogs_the_arm_and_releases_it_when_killed(up: RunningCell) -> None:
    jogging = await asyncio.to_thread(
        subprocess.Popen, command_line("robot", "jog", "--linear", "0,0,0.05", "--seconds", "60", "--domain",
                                       str(up.domain)), env=environment(up.folder), stdout=subprocess.DEVNULL)
    try:
        async with up.listen() as bus:
            owner, joints = bus.reader(topics.MOTION_OWNER), bus.reader(topics.JOINT_STATES)
            now = await until(owner, lambda o: o.jogging)
            assert now.kind == "operator" and now.owner
            first = await joints.next()
            await until(joints, lambda j: largest_way(first, j) > 0.05)
            jogging.kill()
            await until(owner, lambda o: o.kind == "none" and not o.jogging)
            at_rest = await joints.next()
            later = await until(joints, lambda j: j.header.stamp > at_rest.header.stamp + 1_000_000_000)
            # Brakes end where rounding of a ramp puts them: some 1e-31 rad from one message to the next.
            assert largest_way(at_rest, later) < 1e-12 and max(map(abs, later.velocity)) < 1e-12
    finally:
        jogging.kill()
        jogging.wait()
    assert (await asyncio.to_thread(up.command, "robot", "owner")).stdout == "the motion is free\n"


@pytest.mark.parametrize(("arguments", "wanted"), [
    (["take"], "the motion is .* \\(operator\\) since .* UTC\n"), (["give"], "the motion is free\n"),
    (["give"], "the motion is free\n"),
    (["jog"], "zencell: jog: needs --joint NAME=V, --linear X,Y,Z or --angular X,Y,Z\n"),
    (["jog", "--linear", "1,2"],
     "zencell: --linear: '1,2' must be three numbers separated by commas, such as 0.3,-0.1,0\n"),
    (["jog", "--joint", "nose=1"], "zencell: unknown joint 'nose'; choices: panda_finger_joint1, .*\n"),
    (["jog", "--linear", "0,0,1", "--frame", "moon"], "zencell: jog.frame: 'moon' must be .*\n"),
    (["jog", "--linear", "0,0,1", "--seconds", "99"],
     "zencell: --seconds: 99.0 must be more than 0 and at most 60 s\n"),
])
def test_taking_releasing_and_jogging_print_one_line(up: RunningCell, arguments: list[str], wanted: str) -> None:
    said = up.command("robot", *arguments)
    assert re.fullmatch(wanted, said.stdout + said.stderr)


def test_interrupted_waiting_run_ends_with_a_message(up: RunningCell) -> None:
    up.interrupt()
    assert asyncio.run(up.ended(GONE)) == 0
    assert not up.processes()
    assert up.summary["state"] == "IDLE"


def test_run_ends_with_all_balls_in_the_box_and_all_figures(tmp_path: Path) -> None:
    with RunningCell(tmp_path, "run", "panda", "--speed", "10", "--seed", "5", "--set", "world.count=2") as cell:
        assert asyncio.run(cell.ended(90)) == 0, cell.tail()
        assert not cell.processes()
        assert not descendants(cell)
        summary = cell.summary
    assert summary["truth"] == {"in_box": 2, "on_table": 0, "elsewhere": 0, "containers": {"box": 2}}
    assert {k: summary[k] for k in ("cell", "state", "placed", "targets", "rejected", "seed", "speed")} == {
        "cell": "panda", "state": "DONE", "placed": 2, "targets": 2, "rejected": [], "seed": 5, "speed": 10.0,
    }
    assert set(summary) == {
        "cell", "state", "placed", "targets", "rejected", "failures", "retries", "seconds", "plans",
        "frame_to_target_ms", "restarts", "seed", "speed", "truth", "figures", "overlooked", "unexplained",
    }
    seconds = summary["seconds"]
    assert set(seconds) == {"ready", "first_motion", "task", "moving", "planning"}
    assert 0 < seconds["ready"] < seconds["first_motion"]
    assert 0 < seconds["moving"] <= seconds["task"]
    assert seconds["planning"] > 0
    assert len(summary["plans"]) >= 2 * 2  # to the ball and away with it
    for plan in summary["plans"]:
        assert set(plan) == {"planner", "seconds", "fraction", "attempts"}
        assert 0 < plan["fraction"] <= 1
    assert 0 < summary["frame_to_target_ms"]["p50"] <= summary["frame_to_target_ms"]["p99"]
    assert summary["restarts"] == dict.fromkeys(["router", *SERVICES], 0)


def descendants(cell: RunningCell) -> list[str]:
    """Processes that carry the summary's path or the domain in their command line, whatever they are."""
    marks = {str(cell.folder), f"--domain {cell.domain}"}
    found = []
    for process in psutil.process_iter(["cmdline"]):
        command = " ".join(process.info["cmdline"] or [])
        if process.pid != os.getpid() and "cli.main" not in command and any(mark in command for mark in marks):
            found.append(command)
    return found


@pytest.mark.slow
def test_interrupted_run_writes_the_summary_and_leaves_no_process(tmp_path: Path) -> None:
    with RunningCell(tmp_path, "run", "panda", "--speed", "5") as cell:

        async def hold() -> None:
            async with cell.listen() as bus:
                await until(bus.reader(topics.GRIPPER_STATE), lambda state: state.holding)

        asyncio.run(hold())
        started = time.monotonic()
        cell.interrupt()
        assert asyncio.run(cell.ended(GONE)) == 130, cell.tail()
        assert not cell.processes(), f"{time.monotonic() - started:.1f} s after Ctrl-C"
        assert cell.summary["state"] in ("GRASPING", "PLACING")
        assert "Traceback" not in cell.text


@pytest.mark.slow
def test_value_that_only_a_service_can_check_exits_2_with_one_line(tmp_path: Path) -> None:
    with RunningCell(tmp_path, "run", "panda", "--set", "services.camera_simulator.rate=-1") as cell:
        assert asyncio.run(cell.ended(30)) == 2
        said = [line for line in cell.text.splitlines() if line.startswith("zencell: ")]
        assert len(said) == 1
        assert "services.camera_simulator.rate" in said[0] and "-1" in said[0] and "greater than 0" in said[0]
        assert "Traceback" not in cell.text
        assert not cell.processes()
