"""The verbs that look into a cell that is up, and the real zenoh-cli with our codec."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from common.transport.endpoint import endpoint_of
from tests.cli.conftest import CELL, make_folder
from tests.harness import PATIENCE, Place, environment, place_of

ZENOH = Path(sys.executable).parent / "zenoh"
needs_zenoh_cli = pytest.mark.skipif(not ZENOH.exists(), reason="zenoh-cli is not installed beside this Python")


def zenoh(place: Place, *arguments: str) -> list[str]:
    """What zenoh-cli says about the cell."""
    done = subprocess.run(
        [str(ZENOH), "--mode", "client", "--connect", endpoint_of(place.domain), *arguments], cwd=place.folder,
        env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=True,
    )
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = make_folder(tmp_path_factory.mktemp("inspect"))
    (folder / "talk.yaml").write_text(CELL.replace("fakes.first", "fakes.talker").replace("cell: tiny", "cell: talk"))
    with place_of(folder, "talk.yaml") as place:
        yield place


def test_node_list_names_who_is_ready(place: Place) -> None:
    assert place.say("node", "list") == ["talk/last", "talk/middle", "talk/supervisor", "talk/talker"]
    assert json.loads(place.say("node", "list", "--json")[0]) == {"cell": "talk", "service": "last"}


def test_echo_shows_a_picture_in_one_line(place: Place) -> None:
    first, second = place.say("topic", "echo", "camera/image_raw", "--count", "2")
    assert first.startswith("Image 4x3 bgr8 36 B stamp ")
    assert first.endswith(" camera")
    assert first != second


def test_echo_as_json_is_one_object_a_line_without_bytes(place: Place) -> None:
    (line,) = place.say("topic", "echo", "camera/image_raw", "--count", "1", "--json")
    assert json.loads(line)["data"] == "<36 bytes>"


def test_echo_keeps_the_newest_picture_as_a_file(place: Place) -> None:
    assert len(place.say("topic", "echo", "camera/image_raw", "--count", "2", "--save", "seen.png")) == 2
    picture = cv2.imread(str(place.folder / "seen.png"))
    assert picture is not None and picture.shape == (3, 4, 3)
    assert [path.name for path in place.folder.glob("*seen*")] == ["seen.png"]


def test_echo_shows_a_state_that_was_said_long_ago(place: Place) -> None:
    (line,) = place.say("topic", "echo", "pick_place_status", "-n", "1", "--cell", "talk")
    assert json.loads(line)["state"] == "IDLE"
    (line,) = place.say("topic", "echo", "supervisor/status", "-n", "1")
    status = json.loads(line)
    assert [service["name"] for service in status["services"]] == ["router", "talker", "middle", "last"]
    assert {service["state"] for service in status["services"]} == {"ready"}


@pytest.mark.slow
def test_hz_and_bw_measure(place: Place) -> None:
    *_, last = place.say("topic", "hz", "camera/image_raw", "--count", "2", "--json")
    assert json.loads(last)["hz"] > 0
    *_, last = place.say("topic", "bw", "camera/image_raw", "--count", "2")
    assert "B each" in last


def test_stop_that_would_not_outlive_the_executor_is_told_to_who_stops(place: Place) -> None:
    told, task = place.ask("task", "stop").stderr.splitlines()
    assert told == "zencell: stopped since 1970-01-01 00:00:00 UTC by anna (not saved on disk (it is full))"
    assert "the arm is stopped and stays so until a start; the task did not confirm the stop" in task


def test_call_prints_the_answer_as_json(place: Place) -> None:
    (line,) = place.say("call", "task/command", '{"command": "pause"}')
    assert json.loads(line)["paused"] is True
    (line,) = place.say("task", "start")
    assert json.loads(line)["paused"] is False


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["call", "task/command", '{"command": "stop"}'], 1, "task/command: not now [busy]"),
        (["task", "resume", "--cell", "other"], 1, "task/command: no service answers this key"),
        (["call", "task/command", '{"command": "resume"}', "--timeout", "0.3"], 1, "no answer within 0.3 s"),
        (["world", "add", "0.4", "-0.2"], 1, "world/edit: no service answers this key"),
        (["call", "task/command", "{"], 2, "task/command: '{' is not JSON"),
        (["call", "task/command", "[]"], 2, "must be a JSON object"),
        (["call", "task/command", '{"command": "fly"}'], 2, "task/command.command: 'fly' must be 'start', 'pause'"),
        (["call", "gripper/command", '{"id": "a"}'], 2, "gripper/command.width: is missing"),
        (["call", "joint_states", "{}"], 2, "unknown request 'joint_states'"),
        (["topic", "echo", "motion/plan"], 2, "unknown published key 'motion/plan'"),
        (["topic", "echo", "tf", "--save", "tf.png"], 2, "--save: 'tf.png' is for images: tf carries TFMessage"),
        (["topic", "echo", "camera/image_raw", "--save", "seen.jpg"], 2, "'seen.jpg' must be a .png file"),
        (["topic", "echo", "camera/image_raw", "--save", "no/seen.png"], 2, "in an existing folder"),
        (["topic", "hz", "camera/image"], 2, "unknown key 'camera/image' (did you mean 'camera/image_raw'?)"),
        (["world", "add", "0.4", "nan"], 2, "Y: 'nan' must be a number"),
    ],
)
def test_what_goes_wrong_is_one_line(place: Place, arguments: list[str], code: int, message: str) -> None:
    done = place.ask(*arguments)
    assert done.returncode == code
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("zencell: ")
    assert message in line


def test_a_cell_that_is_named_wrongly_is_told_from_one_that_is_not_up(place: Place) -> None:
    done = place.ask("node", "list", "--cell", "other")
    assert done.returncode == 1


@needs_zenoh_cli
def test_zenoh_cli_decodes_states_and_pictures(place: Place) -> None:
    (line,) = zenoh(place, "get", "-s", "talk/pick_place_status", "--decoder", "msgpack", "--line", "{key} {value}")
    key, _, value = line.partition(" ")
    assert key == "talk/pick_place_status"
    assert json.loads(value)["state"] == "IDLE"


@needs_zenoh_cli
def test_zenoh_cli_reads_the_line_that_up_prints(place: Place) -> None:
    listening = subprocess.Popen(
        [str(ZENOH), "--mode", "client", "--connect", endpoint_of(place.domain), "subscribe",
         "-k", "talk/**", "--decoder", "msgpack", "--line", "{key} {value}"],
        stdout=subprocess.PIPE, text=True, env=environment(),
    )
    assert listening.stdout is not None
    seen: dict[str, str] = {}
    try:
        for line in listening.stdout:
            key, _, value = line.rstrip().partition(" ")
            seen[key] = value
            if {"talk/camera/image_raw", "talk/supervisor/status", "talk/counters/supervisor"} <= seen.keys():
                break
    finally:
        listening.kill()
        listening.wait()
        listening.stdout.close()
    assert seen["talk/camera/image_raw"].startswith("Image 4x3 bgr8 36 B stamp ")
    assert json.loads(seen["talk/supervisor/status"])["cell"] == "talk"


@needs_zenoh_cli
def test_zenoh_cli_can_ask_a_request(place: Place) -> None:
    (line,) = zenoh(place, "get", "-s", "talk/task/command", "--encoder", "msgpack", "-v", '{"command": "pause"}',
                    "--decoder", "msgpack")
    assert json.loads(line)["paused"] is True


def test_doctor_knows_our_own_router(place: Place) -> None:
    done = place.ask("doctor")
    assert "a router of zencell answers there" in done.stdout
