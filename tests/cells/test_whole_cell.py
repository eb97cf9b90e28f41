"""The Panda cell with real processes: start, closed loop, figures, external clients, end."""

import asyncio
import json
import os
import re
import shlex
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from common import topics
from common.config import load_cell
from common.messages import JointState, SupervisorStatus
from tests.harness import PATIENCE, Place, RunningCell, command_line, environment, until
from tests.simulated.visited import in_box

pytestmark = pytest.mark.cell

SERVICES = [name for name in load_cell("panda").services if name != "viewer"]
TOPICS = ("joint_states", "camera/image_raw", "camera/camera_info", "gripper/state", "tf", "planning_scene",
          "detected_objects", "validated_targets", "pick_place_status", "scene_balls", "supervisor/status")


def all_ready(status: SupervisorStatus) -> bool:
    return len(status.services) == 1 + len(SERVICES) and all(service.state == "ready" for service in status.services)


def largest_change(before: JointState, after: JointState) -> float:
    return max(abs(a - b) for a, b in zip(after.position, before.position, strict=True))


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory):
    """A cell at speed 1 whose task waits."""
    with RunningCell(tmp_path_factory.mktemp("up"), "up", "panda", "--set", "autostart=false") as cell:

        async def ready() -> None:
            async with cell.listen() as bus:
                await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready)

        asyncio.run(ready())
        deadline = time.monotonic() + 30.0
        while "zenoh --mode" not in cell.text:  # printed after that status was published
            assert time.monotonic() < deadline, cell.tail()
            time.sleep(0.05)
        yield cell


@pytest.mark.slow
def test_every_process_runs_once(up: RunningCell) -> None:
    assert sorted(up.processes()) == sorted(["router", *SERVICES])


@pytest.mark.slow
def test_printed_zenoh_cli_command_decodes_the_topics(up: RunningCell) -> None:
    program, *arguments = shlex.split(next(line for line in up.text.splitlines() if line.startswith("zenoh --mode")))
    assert arguments == ["--mode", "client", "--connect", up.endpoint, "subscribe", "-k", "panda/**", "--decoder",
                         "msgpack", "--line", "{key} {value}"]
    wanted, seen = {f"panda/{key}" for key in TOPICS}, {}
    with subprocess.Popen(
        [str(Path(sys.executable).with_name(program)), *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as reading:
        too_late = threading.Timer(30.0, reading.kill)
        too_late.start()
        for line in reading.stdout:
            key, _, value = line.rstrip("\n").partition(" ")
            seen[key] = value
            if wanted <= seen.keys():
                break
        too_late.cancel()
        reading.kill()
    assert not wanted - seen.keys(), list(seen)
    image = seen["panda/camera/image_raw"]
    assert "640" in image and "bgr8" in image and len(image) < 400
    for key in wanted - {"panda/camera/image_raw"}:
        assert isinstance(json.loads(seen[key]), dict), seen[key]


@pytest.mark.slow
async def test_terminal_jogs_the_arm_and_releases_it_when_killed(up: RunningCell) -> None:
    command = command_line("robot", "jog", "--linear", "0,0,0.05", "--seconds", "60", "--domain", str(up.domain))
    jogging = await asyncio.to_thread(
        subprocess.Popen, command, env=environment(up.folder), stdout=subprocess.DEVNULL)
    try:
        async with up.listen() as bus:
            owner, joints = bus.reader(topics.MOTION_OWNER), bus.reader(topics.JOINT_STATES)
            now = await until(owner, lambda o: o.jogging)
            assert now.kind == "operator" and now.owner
            first = await joints.next()
            await until(joints, lambda j: largest_change(first, j) > 0.02)
            jogging.kill()
            await until(owner, lambda o: o.kind == "none" and not o.jogging)
            at_rest = await until(joints, lambda j: max(map(abs, j.velocity)) < 1e-12)  # may come after the owner
            later = await until(joints, lambda j: j.header.stamp > at_rest.header.stamp + 500_000_000)
            # Brakes end where rounding of a ramp puts them: some 1e-31 rad from one message to the next.
            assert largest_change(at_rest, later) < 1e-12 and max(map(abs, later.velocity)) < 1e-12
    finally:
        jogging.kill()
        jogging.wait()


@pytest.mark.slow
def test_taking_releasing_and_jogging_print_one_line(up: RunningCell) -> None:
    place = Place(up.folder, up.domain)
    for arguments, wanted in (
        (["owner"], "the motion is free\n"),
        (["take"], "the motion is .* \\(operator\\) since .* UTC\n"),
        (["give"], "the motion is free\n"),
        (["give"], "the motion is free\n"),
        (["jog"], "zencell: jog: needs --joint NAME=V, --linear X,Y,Z or --angular X,Y,Z\n"),
        (["jog", "--linear", "1,2"],
         "zencell: --linear: '1,2' must be three numbers separated by commas, such as 0.3,-0.1,0\n"),
        (["jog", "--joint", "nose=1"], "zencell: unknown joint 'nose'; choices: panda_finger_joint1, .*\n"),
        (["jog", "--linear", "0,0,1", "--frame", "moon"], "zencell: jog.frame: 'moon' must be .*\n"),
        (["jog", "--linear", "0,0,1", "--seconds", "99"],
         "zencell: --seconds: 99.0 must be more than 0 and at most 60 s\n"),
    ):
        answer = place.ask("robot", *arguments)
        assert re.fullmatch(wanted, answer.stdout + answer.stderr), arguments


@pytest.mark.slow
def test_interrupted_cell_ends_with_a_summary_and_no_process(up: RunningCell) -> None:
    up.interrupt()
    assert asyncio.run(up.ended(PATIENCE)) == 0
    assert not up.processes() and up.summary["state"] == "IDLE"


def descendants(cell: RunningCell) -> list[str]:
    """Return the command lines of all processes with the summary's path or the domain in them."""
    commands = [" ".join(process.info["cmdline"] or []) for process in psutil.process_iter(["cmdline"])
                if process.pid != os.getpid()]
    return [command for command in commands if "cli.main" not in command
            and any(mark in command for mark in (str(cell.folder), f"--domain {cell.domain}"))]


def test_run_ends_with_all_balls_in_the_box_and_all_figures(tmp_path: Path) -> None:
    with RunningCell(tmp_path, "run", "panda", "--speed", "10", "--seed", "5", "--set", "world.count=1") as cell:
        assert asyncio.run(cell.ended(90)) == 0, cell.tail()
        assert not cell.processes() and not descendants(cell)
        summary = cell.summary
    assert summary["truth"] == in_box(1)
    assert {k: summary[k] for k in ("cell", "state", "placed", "targets", "rejected", "seed", "speed")} == {
        "cell": "panda", "state": "DONE", "placed": 1, "targets": 1, "rejected": [], "seed": 5, "speed": 10.0,
    }
    assert set(summary) == {
        "cell", "state", "placed", "targets", "rejected", "failures", "retries", "seconds", "plans",
        "frame_to_target_ms", "restarts", "seed", "speed", "truth", "figures", "overlooked", "unexplained",
    }
    seconds = summary["seconds"]
    assert set(seconds) == {"ready", "first_motion", "task", "moving", "planning"}
    assert 0 < seconds["ready"] < seconds["first_motion"] and 0 < seconds["moving"] <= seconds["task"]
    assert seconds["planning"] > 0
    assert len(summary["plans"]) >= 2  # to the ball and away with it
    for plan in summary["plans"]:
        assert set(plan) == {"planner", "seconds", "fraction", "attempts"} and 0 < plan["fraction"] <= 1
    assert 0 < summary["frame_to_target_ms"]["p50"] <= summary["frame_to_target_ms"]["p99"]
    assert summary["restarts"] == dict.fromkeys(["router", *SERVICES], 0)
