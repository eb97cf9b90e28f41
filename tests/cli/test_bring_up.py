"""The real command with tiny services: order, restarts, and that nothing is left behind."""

import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.harness import Zencell

Start = Callable[..., Zencell]
RUNNING = "zenoh --mode client"  # the last line that `up` writes when all is ready
GONE = 3.0  # [s] after its supervisor was killed


def test_services_are_let_through_in_order_and_stopped_in_reverse(zencell: Start) -> None:
    command = zencell("up", "tiny.yaml")
    assert f"tcp/127.0.0.1:{7447 + command.domain}" in command.until(RUNNING)
    assert sorted(command.children()) == ["first", "last", "middle", "router"]
    command.interrupt()
    assert command.end() == 0
    hello = [line for line in command.lines if "hello from" in line]
    assert hello == [f"{name}: hello from {name}" for name in ("first", "middle", "last")]
    stopped = [line.split()[1] for line in command.lines if "stopped" in line]
    assert stopped == ["last:", "middle:", "first:", "router:"]
    assert not command.children()
    assert not any("Traceback" in line for line in command.lines)


@pytest.mark.slow
def test_what_crashes_at_its_start_or_is_killed_later_is_started_again_and_shown(zencell: Start) -> None:
    command = zencell("up", "tiny.yaml", "--set", "services.middle.behave=crash once")
    command.until("RuntimeError: a bug")
    command.until("middle ended (exit code 1)")
    command.until(RUNNING)
    for victim in ("middle", "router"):
        before = command.children()[victim].pid
        command.children()[victim].kill()
        command.until(f"{victim} ended (killed by SIGKILL); restarting it in ")
        command.until(f"{victim} is ready again")
        assert command.children()[victim].pid != before
    command.interrupt()
    assert command.end() == 0
    assert not command.children()


@pytest.mark.slow
def test_wrong_configuration_of_one_service_ends_everything_with_one_line(zencell: Start) -> None:
    command = zencell("up", "tiny.yaml", "--set", "services.middle.plcaed=3")
    assert command.end() == 2
    last = command.lines[-1] or command.lines[-2]
    assert last == "zencell: services.middle.plcaed: 3 is not a parameter; choices: behave, placed"
    assert not any("Traceback" in line for line in command.lines)
    assert not command.children()


@pytest.mark.slow
def test_what_turns_out_wrong_only_in_use_ends_everything_too(zencell: Start) -> None:
    command = zencell("up", "tiny.yaml", "--set", "services.last.behave=wrong", "--log-json")
    assert command.end() == 2
    assert "zencell: behave: 'wrong' cannot be done" in command.lines
    assert not command.children()


@pytest.mark.parametrize("phase", [
    pytest.param("hello from first", marks=pytest.mark.slow), "first: hello",
    pytest.param("hello from last", marks=pytest.mark.slow),
])
def test_interrupted_at_any_time_no_process_is_left(zencell: Start, phase: str) -> None:
    command = zencell("up", "tiny.yaml")
    command.until(phase)
    command.interrupt()
    assert command.end() in (0, 130)
    assert not command.children()
    assert not any("Traceback" in line for line in command.lines)


@pytest.mark.slow
def test_interrupted_before_anything_is_up_no_process_is_left(zencell: Start) -> None:
    command = zencell("run", "tiny.yaml", "--set", "services.first.behave=never ready", "--summary", "out.json")
    command.until("waiting for the moon")
    command.interrupt()
    assert command.end() == 130
    assert not command.children()


def test_a_frozen_service_is_killed_and_a_second_interrupt_does_so_at_once(zencell: Start) -> None:
    command = zencell("up", "tiny.yaml")
    command.until(RUNNING)
    command.children()["middle"].send_signal(signal.SIGSTOP)
    command.interrupt()
    command.until("stopped")  # the last one; the middle cannot
    command.interrupt()
    command.until("middle did not end in time; killed")
    assert command.end() == 0
    assert not command.children()


def test_run_ends_with_the_task_and_writes_the_summary(zencell: Start, folder: Path) -> None:
    command = zencell(
        "run", "tiny.yaml", "--set", "services.last.behave=done", "--set", "services.last.placed=2",
        "--summary", "out.json", "--seed", "7", "--speed", "2",
    )
    assert command.end() == 0
    summary = json.loads((folder / "out.json").read_text())
    assert (summary["state"], summary["placed"], summary["seed"], summary["speed"]) == ("DONE", 2, 7, 2.0)
    assert summary["truth"] is None
    assert summary["restarts"] == {"router": 0, "first": 0, "middle": 0, "last": 0}
    assert summary["seconds"]["ready"] > 0
    assert "tiny: DONE, 2 of 2 placed" in command.lines


@pytest.mark.slow
def test_run_of_a_task_that_ends_in_error_exits_1(zencell: Start, folder: Path) -> None:
    command = zencell("run", "tiny.yaml", "--set", "services.last.behave=error", "--summary", "out.json")
    assert command.end() == 1
    assert json.loads((folder / "out.json").read_text())["state"] == "ERROR"


def test_interrupted_run_writes_the_summary(zencell: Start, folder: Path) -> None:
    command = zencell("run", "tiny.yaml", "--summary", "out.json")
    command.until("0 of 2 placed - IDLE")
    command.interrupt()
    assert command.end() == 130
    assert json.loads((folder / "out.json").read_text())["state"] == "IDLE"
    assert not command.children()


def test_a_port_in_use_names_domain_and_process_and_a_killed_supervisor_leaves_no_process(zencell: Start) -> None:
    first = zencell("up", "tiny.yaml")
    first.until(RUNNING)
    second = zencell("up", "tiny.yaml")
    assert second.end() == 2
    (line,) = [line for line in second.lines if line]
    assert line.startswith(f"zencell: port {7447 + first.domain} (domain {first.domain}) is in use by process ")
    assert "services.router" in line
    assert sorted(first.children()) == ["first", "last", "middle", "router"]
    first.children()["middle"].send_signal(signal.SIGSTOP)  # not even what is frozen is left
    first.process.kill()
    first.until_childless(GONE)


@pytest.mark.slow
def test_log_lines_as_json(zencell: Start) -> None:
    command = zencell("up", "tiny.yaml", "--log-json")
    command.until(RUNNING)
    command.interrupt()
    assert command.end() == 0
    for line in filter(None, command.lines):
        value = json.loads(line)
        assert {"time", "service", "level", "message"} <= value.keys()
