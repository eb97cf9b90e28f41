"""The real command with tiny services: order, restarts, and no process left behind."""

import json
import signal

import pytest

from tests.harness import ask

RUNNING = "zenoh --mode client"  # the last line of `up` when all services are ready


def test_services_start_in_order_and_stop_in_reverse_and_the_port_is_theirs(zencell, folder):
    command = zencell("up", "tiny.yaml")
    assert f"tcp/127.0.0.1:{7447 + command.domain}" in command.until(RUNNING)
    assert sorted(command.children()) == ["first", "last", "middle", "router"]
    second = ask(folder, "up", "tiny.yaml", "--domain", str(command.domain))
    (line,) = second.stderr.splitlines()
    assert second.returncode == 2 and "services.router" in line
    assert line.startswith(f"zencell: port {7447 + command.domain} (domain {command.domain}) is in use by process ")
    command.interrupt()
    assert command.end() == 0
    hello = [line for line in command.lines if "hello from" in line]
    assert hello == [f"{name}: hello from {name}" for name in ("first", "middle", "last")]
    stopped = [line.split()[1] for line in command.lines if "stopped" in line]
    assert stopped == ["last:", "middle:", "first:", "router:"]
    assert not command.children()
    assert not any("Traceback" in line for line in command.lines)


@pytest.mark.slow
def test_crashed_and_killed_services_are_restarted(zencell):
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
@pytest.mark.parametrize(("options", "wanted"), [
    (["--set", "services.middle.plcaed=3"], "services.middle.plcaed: 3 is not a parameter; choices: behave, placed"),
    (["--set", "services.last.behave=wrong", "--log-json"], "services.last.behave: 'wrong' cannot be done"),
])
def test_rejected_configuration_of_one_service_ends_the_cell_with_one_line(zencell, options, wanted):
    command = zencell("up", "tiny.yaml", *options)
    assert command.end() == 2
    assert [line for line in command.lines if line.startswith("zencell: ")] == [f"zencell: {wanted}"]
    assert not any("Traceback" in line for line in command.lines)
    assert len([*filter(None, command.lines)]) == 1 or "behave=" in options[1], "a process was started"
    assert not command.children()


@pytest.mark.parametrize(("behaviour", "phase"), [
    pytest.param("never ready", "waiting for the moon", marks=pytest.mark.slow),
    pytest.param("well", "hello from last", marks=pytest.mark.slow), ("well", "0 of 2 placed - IDLE"),
])
def test_interrupted_run_leaves_a_summary_and_no_process(zencell, folder, behaviour, phase):
    command = zencell("run", "tiny.yaml", "--set", f"services.first.behave={behaviour}", "--summary", "out.json")
    command.until(phase)
    command.interrupt()
    assert command.end() == 130
    assert json.loads((folder / "out.json").read_text())["state"] == "IDLE"
    assert not command.children()
    assert not any("Traceback" in line for line in command.lines)


def test_frozen_service_is_killed_and_at_once_after_a_second_interrupt(zencell):
    command = zencell("up", "tiny.yaml")
    command.until(RUNNING)
    command.children()["middle"].send_signal(signal.SIGSTOP)
    command.interrupt()
    command.until("stopped")  # the last one; the middle cannot
    command.interrupt()
    command.until("middle did not end in time; killed")
    assert command.end() == 0
    assert not command.children()


def test_killed_supervisor_leaves_no_process_not_even_a_frozen_one(zencell):
    command = zencell("up", "tiny.yaml")
    command.until(RUNNING)
    command.children()["middle"].send_signal(signal.SIGSTOP)
    command.process.kill()
    command.until_childless()


@pytest.mark.parametrize(("behaviour", "code", "state"), [
    ("done", 0, "DONE"), pytest.param("error", 1, "ERROR", marks=pytest.mark.slow)])
def test_run_ends_with_its_task_and_writes_the_summary(zencell, folder, behaviour, code, state):
    command = zencell("run", "tiny.yaml", "--set", f"services.last.behave={behaviour}", "--set",
                      "services.last.placed=2", "--summary", "out.json", "--seed", "7", "--speed", "2")
    assert command.end() == code
    summary = json.loads((folder / "out.json").read_text())
    assert [summary[key] for key in ("state", "placed", "seed", "speed", "truth")] == [state, 2, 7, 2.0, None]
    assert summary["restarts"] == {"router": 0, "first": 0, "middle": 0, "last": 0}
    assert summary["seconds"]["ready"] > 0
    assert f"tiny: {state}, 2 of 2 placed" in command.lines
