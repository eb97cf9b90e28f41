"""Commands that look into a running cell, at a speed at which wrong clocks show, and zencell's codec in zenoh-cli."""

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import pytest

from common.transport.endpoint import endpoint_of
from tests.cli.conftest import make_folder
from tests.cli.fakes.talker import AGE
from tests.harness import PATIENCE, Place, environment, place_of

SPEED = 2.0
ZENOH = Path(sys.executable).parent / "zenoh"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = make_folder(tmp_path_factory.mktemp("inspection"), "talk", "talker")
    with place_of(folder, "talk.yaml", "--speed", str(SPEED)) as place:
        yield place


def test_nodes_are_listed_and_described(place):
    assert place.say("node", "list") == ["talk/last", "talk/middle", "talk/supervisor", "talk/talker"]
    assert json.loads(place.say("node", "list", "--json")[0]) == {"cell": "talk", "service": "last"}
    (line,) = place.say("node", "info", "talker", "--cell", "talk.yaml", "--json")
    info = json.loads(line)
    assert info["doc"] == "Publishes frames and old images, and answers requests of the task."
    assert (info["cell"], info["state"], info["restarts"], info["pid"] > 1) == ("talk", "ready", 0, True)
    assert (info["reads"], info["calls"]) == (["gripper/state"], ["world/edit"])
    assert (info["writes"], info["serves"]) == (
        ["camera/image_raw", "tf", "tf_static"], ["motion/stop", "task/command"])
    (parameter,) = info["parameters"]
    assert (parameter["path"], parameter["value"], parameter["minimum"]) == ("services.talker.width", 4, 1)


def test_graph_marks_running_services(place):
    done = place.ask("graph", "talk.yaml", "-o", "talk.svg")  # what services print while they are wired is on stderr
    (line,) = done.stdout.splitlines()
    assert done.returncode == 0 and line.endswith(", 3 services alive")
    drawing = ET.parse(place.folder / "talk.svg")
    assert "green: alive; dashed and grey: not alive" in [each.text for each in drawing.iter()]


def test_transforms_are_chained_and_listed_as_trees(place):
    (line,) = place.say("tf", "echo", "world", "hand", "--once")
    assert line == ("hand in world: position 1.2500 0.0000 0.0000 m, quaternion 0.0000 0.0000 0.0000 1.0000, "
                    "rpy 0.00 0.00 0.00 deg")
    first, second = place.say("tf", "echo", "hand", "world", "--count", "2", "--rate", "50", "--json")
    assert json.loads(first)["position"] == json.loads(second)["position"] == [-1.25, 0.0, 0.0]
    assert place.say("tf", "frames") == ["map", "  cart", "world", "  base", "    hand  (moves)"]
    assert json.loads(place.say("tf", "frames", "--json")[-1]) == {"frame": "hand", "parent": "base", "moves": True}


def test_echo_shows_an_image_in_one_line_and_saves_it(place):
    first, second = place.say("topic", "echo", "camera/image_raw", "--count", "2", "--save", "seen.png")
    assert first.startswith("Image 4x3 bgr8 36 B stamp ") and first.endswith(" camera") and first != second
    image = cv2.imread(str(place.folder / "seen.png"))
    assert image is not None and image.shape == (3, 4, 3)
    assert [path.name for path in place.folder.glob("*seen*")] == ["seen.png"]
    (line,) = place.say("topic", "echo", "camera/image_raw", "--count", "1", "--json")
    assert json.loads(line)["data"] == "<36 bytes>"


def test_echo_shows_states_published_before_it_started(place):
    (line,) = place.say("topic", "echo", "pick_place_status", "-n", "1", "--cell", "talk")
    assert json.loads(line)["state"] == "IDLE"
    (line,) = place.say("topic", "echo", "supervisor/status", "-n", "1")
    services = json.loads(line)["services"]
    assert [service["name"] for service in services] == ["router", "talker", "middle", "last"]
    assert {service["state"] for service in services} == {"ready"}


@pytest.mark.slow
def test_rate_and_bandwidth_are_measured(place):
    *_, last = place.say("topic", "hz", "camera/image_raw", "--count", "2", "--json")
    assert json.loads(last)["hz"] > 0
    *_, last = place.say("topic", "bw", "camera/image_raw", "--count", "2")
    assert "B each" in last


def test_delay_is_in_wall_time_at_any_speed(place):
    figures = json.loads(place.say("topic", "delay", "camera/image_raw", "--count", "1", "--json")[-1])
    assert figures["messages"] > 0
    # By the wall clock alone cell time would lie in the future, and the delays would be negative.
    assert AGE / SPEED * 1e3 <= figures["min"] <= figures["mean"] <= figures["p99"] <= figures["max"]


@contextmanager
def published(place: Place, key: str, *arguments: str) -> Iterator[None]:
    """Publish a key during the block, which starts when it is received."""
    publishing = place.start("topic", "pub", key, *arguments)
    try:
        while place.ask("topic", "echo", key, "--count", "1").returncode:  # silence of an unknown key is an error
            assert publishing.process.poll() is None
        yield
    finally:
        publishing.interrupt()
        assert publishing.end() == 130


def test_custom_key_is_published_unchanged_and_has_no_delay(place):
    with published(place, "my/key", '{"a": [1, {"b": null}]}', "--rate", "20"):
        (line,) = place.say("topic", "echo", "my/key", "--count", "1")
        done = place.ask("topic", "delay", "my/key", "--count", "3")
    assert json.loads(line) == {"a": [1, {"b": None}]}
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("zencell: my/key: its messages have no header with a stamp")


def test_published_state_is_stamped_in_cell_time(place):
    with published(place, "gripper/state", '{"width": 0.04}', "--rate", "5"):
        (line,) = place.say("topic", "echo", "gripper/state", "--count", "1")
        delay = json.loads(place.say("topic", "delay", "gripper/state", "--count", "2", "--json")[-1])
    state = json.loads(line)
    assert state["width"] == 0.04 and state["header"]["stamp"] > 0
    assert delay["min"] > -50  # in another clock it would be seconds in the future


def test_message_published_once_reaches_a_subscriber(place):
    echoing = place.start("topic", "echo", "log", "--count", "1", "--json")
    while echoing.process.poll() is None:  # until it has subscribed, each attempt is lost
        assert place.ask("topic", "pub", "log", '{"service": "me", "level": "info", "message": "hello"}',
                         "--once").returncode == 0
    assert json.loads(echoing.until("{"))["message"] == "hello"
    assert echoing.end() == 0


def test_top_shows_processes_and_topics(place):
    view = json.loads(*place.say("top", "--once", "--json"))
    services = {row["service"]: row for row in view["services"]}
    assert {"router", "talker", "middle", "last", "supervisor"} <= services.keys()
    for name in ("router", "talker", "supervisor"):
        row = services[name]
        assert row["state"] == "ready" and row["memory"] > 1 and row["cpu"] >= 0
    image = next(row for row in view["topics"] if row["topic"] == "camera/image_raw")
    assert image["hz"] > 0 and image["bytes_per_second"] > 0 and image["p50"] >= AGE / SPEED * 1e3
    assert view["speed"] == SPEED


@pytest.mark.slow
def test_top_prints_plain_lines_until_interrupted(place):
    watching = place.start("top")
    for _ in range(2):
        watching.until("talk at speed 2")
        watching.until("camera/image_raw")
    watching.interrupt()
    assert watching.end() == 130
    assert not any("\x1b" in line for line in watching.lines)


def test_requests_are_answered_as_json(place):
    assert json.loads(*place.say("call", "task/command", '{"command": "pause"}'))["paused"] is True
    assert json.loads(*place.say("task", "start"))["paused"] is False


def test_stop_that_is_not_saved_is_reported_to_the_operator(place):
    motion, task = place.ask("task", "stop").stderr.splitlines()
    assert motion == "zencell: stopped since 1970-01-01 00:00:00 UTC by anna (not saved on disk (it is full))"
    assert "the arm is stopped and stays so until a start; the task did not confirm the stop" in task


@pytest.mark.parametrize(("arguments", "code", "message"), [
    (["tf", "echo", "world", "hnad", "--once"], 2, "unknown frame 'hnad' (did you mean 'hand'?); choices: base, cart"),
    (["tf", "echo", "world", "cart", "--once"], 2, "the root of one is 'world', of the other 'map'"),
    (["tf", "frames", "--cell", "other"], 1, "no message on other/tf and other/tf_static"),
    (["node", "list", "--cell", "other"], 1, "other"),
    (["call", "task/command", '{"command": "stop"}'], 1, "task/command: not now [busy]"),
    (["task", "resume", "--cell", "other"], 1, "task/command: no service answers this key"),
    (["call", "task/command", '{"command": "resume"}', "--timeout", "0.3"], 1, "no answer within 0.3 s"),
    (["world", "add", "0.4", "-0.2"], 1, "world/edit: no service answers this key"),
    (["topic", "delay", "camera/image_rwa", "-n", "1"], 2, "did you mean 'camera/image_raw'?"),
])
def test_rejection_by_the_cell_is_one_line(place, arguments, code, message, monkeypatch):
    if "other" in arguments:  # nothing comes; the frames of the cell may come late
        monkeypatch.setattr("common.client.frames.TIMEOUT", 0.5)
    done = place.ask(*arguments)
    (line,) = done.stderr.splitlines()
    assert (done.returncode, done.stdout) == (code, "")
    assert line.startswith("zencell: ") and message in line


def zenoh(place: Place, *arguments: str) -> str:
    """Return the only line that zenoh-cli prints about the cell."""
    command = [str(ZENOH), "--mode", "client", "--connect", endpoint_of(place.domain), *arguments]
    (line,) = subprocess.run(command, cwd=place.folder, env=environment(), capture_output=True, text=True,
                             timeout=PATIENCE, check=True).stdout.splitlines()
    return line


@pytest.mark.skipif(not ZENOH.exists(), reason="zenoh-cli is not installed next to this Python")
def test_zenoh_cli_decodes_states_and_images_and_encodes_requests(place):
    line = zenoh(place, "get", "-s", "talk/pick_place_status", "--decoder", "msgpack", "--line", "{key} {value}")
    key, _, value = line.partition(" ")
    assert (key, json.loads(value)["state"]) == ("talk/pick_place_status", "IDLE")
    line = zenoh(place, "get", "-s", "talk/task/command", "--encoder", "msgpack", "-v", '{"command": "pause"}',
                 "--decoder", "msgpack")
    assert json.loads(line)["paused"] is True
    listening = subprocess.Popen(
        [str(ZENOH), "--mode", "client", "--connect", endpoint_of(place.domain), "subscribe", "-k", "talk/**",
         "--decoder", "msgpack", "--line", "{key} {value}"], stdout=subprocess.PIPE, text=True, env=environment())
    assert listening.stdout is not None
    wanted, seen = {"talk/camera/image_raw", "talk/supervisor/status", "talk/counters/supervisor"}, {}
    try:
        while not wanted <= seen.keys():
            key, _, seen[key] = listening.stdout.readline().rstrip().partition(" ")
    finally:
        listening.kill()
        listening.wait()
        listening.stdout.close()
    assert seen["talk/camera/image_raw"].startswith("Image 4x3 bgr8 36 B stamp ")
    assert json.loads(seen["talk/supervisor/status"])["cell"] == "talk"


def test_doctor_finds_the_cell_its_router_and_its_version(place):
    findings = [json.loads(line) for line in place.ask("doctor", "--json").stdout.splitlines()]
    found = [finding["what"] for finding in findings]
    assert any("a router of zencell answers there" in what for what in found)
    assert f"cell talk at {endpoint_of(place.domain)} has the message version of this tool" in found
    assert any(what.startswith("a cell runs or starts: zencell up talk.yaml (") for what in found)
    assert all(finding["remedy"] for finding in findings if finding["level"] != "ok")
