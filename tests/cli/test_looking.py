"""The verbs that look at a cell that is up, with real processes, at a speed at which wrong clocks show."""

import json
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.cli.conftest import CELL, make_folder
from tests.harness import Place, place_of

SPEED = "2"
LATE = 0.4  # [s] of cell time: how old the pictures are when they are sent

FRAMES = f'''"""Says where things are, and sends pictures late."""
import asyncio
from common import topics
from common.config import Parameters
from common.messages import Header, Image, Pose, TFMessage, TransformStamped, Vector3
from common.process.service import main
from pydantic import Field

class Config(Parameters):
    """How it looks."""
    width: int = Field(4, ge=1, description="of a picture [px]")

def at(bus, parent, child, x):
    return TransformStamped(header=bus.header(parent), child_frame_id=child, transform=Pose(position=Vector3(x=x)))

async def run(bus, config):
    images = bus.writer(topics.CAMERA_IMAGE)
    fixed, moving = bus.writer(topics.TF_STATIC), bus.writer(topics.TF)
    gripper = bus.reader(topics.GRIPPER_STATE)
    bus.client(topics.MOTION_STOP)
    fixed.put(TFMessage(transforms=[at(bus, "world", "base", 1.0), at(bus, "map", "cart", 0.5)]))
    await bus.ready()
    while True:
        moving.put(TFMessage(transforms=[at(bus, "base", "hand", 0.25)]))
        header = Header(stamp=bus.clock.now_ns() - {int(LATE * 1e9)}, frame_id="camera")
        images.put(Image(header=header, height=3, width=config.width, encoding="mono8", data=bytes(3 * config.width)))
        await asyncio.sleep(0.05)

if __name__ == "__main__":
    main(run, Config)
'''


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = make_folder(tmp_path_factory.mktemp("looking"))
    (folder / "fakes" / "frames.py").write_text(FRAMES)
    (folder / "look.yaml").write_text(CELL.replace("fakes.first", "fakes.frames").replace("cell: tiny", "cell: look"))
    with place_of(folder, "look.yaml", "--speed", SPEED) as place:
        yield place


def test_tf_echo_chains_what_is_fixed_and_what_moves(place: Place) -> None:
    (line,) = place.say("tf", "echo", "world", "hand", "--once")
    assert line == ("hand in world: position 1.2500 0.0000 0.0000 m, quaternion 0.0000 0.0000 0.0000 1.0000, "
                    "rpy 0.00 0.00 0.00 deg")
    first, second = place.say("tf", "echo", "hand", "world", "--count", "2", "--rate", "50", "--json")
    assert json.loads(first)["position"] == json.loads(second)["position"] == [-1.25, 0.0, 0.0]


def test_tf_frames_prints_the_trees(place: Place) -> None:
    assert place.say("tf", "frames") == ["map", "  cart", "world", "  base", "    hand  (moves)"]
    assert json.loads(place.say("tf", "frames", "--json")[-1]) == {"frame": "hand", "parent": "base", "moves": True}


def test_delay_is_wall_time_at_any_speed(place: Place) -> None:
    figures = json.loads(place.say("topic", "delay", "camera/image_raw", "--count", "1", "--json")[-1])
    assert figures["messages"] > 0
    # By the wall clock alone cell time would lie in the future, and the ages would be negative.
    assert figures["min"] >= LATE / float(SPEED) * 1e3
    assert figures["min"] <= figures["mean"] <= figures["p99"] <= figures["max"]


@contextmanager
def published(place: Place, key: str, *arguments: str) -> Iterator[None]:
    """A key that is published during the block, and was heard before."""
    publishing = place.start("topic", "pub", key, *arguments)
    try:
        place.ask("topic", "echo", key, "--count", "1")
        yield
    finally:
        publishing.interrupt()
        assert publishing.end() == 130


def test_messages_without_a_stamp_have_no_delay(place: Place) -> None:
    with published(place, "my/key", '{"a": 1}', "--rate", "20"):
        done = place.ask("topic", "delay", "my/key", "--count", "3")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("zencell: my/key: its messages have no header with a stamp")


def test_published_state_can_be_asked_for_while_it_is_published(place: Place) -> None:
    with published(place, "gripper/state", '{"width": 0.04}', "--rate", "5"):
        (line,) = place.say("topic", "echo", "gripper/state", "--count", "1")
        delayed = json.loads(place.say("topic", "delay", "gripper/state", "--count", "2", "--json")[-1])
    said = json.loads(line)
    assert said["width"] == 0.04
    assert said["header"]["stamp"] > 0
    assert delayed["min"] > -50  # in another clock it would be seconds in the future


def test_keys_of_ones_own_are_published_as_they_were_written(place: Place) -> None:
    with published(place, "my/other", '{"a": [1, {"b": null}]}', "-r", "10"):
        (line,) = place.say("topic", "echo", "my/other", "--count", "1")
    assert json.loads(line) == {"a": [1, {"b": None}]}


def test_publishing_once_reaches_who_listens_and_ends(place: Place) -> None:
    echoing = place.start("topic", "echo", "log", "--count", "1", "--json")
    # What listens is there as soon as it has heard one; until then each try is one message.
    while echoing.process.poll() is None:
        assert place.ask("topic", "pub", "log", '{"service": "me", "level": "info", "message": "hello"}',
                         "--once").returncode == 0
    assert json.loads(echoing.until("{"))["message"] == "hello"
    assert echoing.end() == 0


def test_top_shows_processes_and_topics(place: Place) -> None:
    (line,) = place.say("top", "--once", "--json")
    view = json.loads(line)
    services = {row["service"]: row for row in view["services"]}
    assert {"router", "frames", "middle", "last", "supervisor"} <= services.keys()
    for name in ("router", "frames", "supervisor"):
        assert services[name]["state"] == "ready"
        assert services[name]["memory"] > 1
        assert services[name]["cpu"] >= 0
    image = next(row for row in view["topics"] if row["topic"] == "camera/image_raw")
    assert image["hz"] > 0
    assert image["bytes_per_second"] > 0
    assert image["p50"] >= LATE / float(SPEED) * 1e3
    assert view["speed"] == float(SPEED)


@pytest.mark.slow
def test_top_goes_on_in_plain_lines_until_interrupted(place: Place) -> None:
    watching = place.start("top")
    for _ in range(2):
        watching.until("look at speed 2")
        watching.until("camera/image_raw")
    watching.interrupt()
    assert watching.end() == 130
    assert not any("\x1b" in line for line in watching.lines)


def test_node_info_tells_wiring_and_how_the_process_is(place: Place) -> None:
    (line,) = place.say("node", "info", "frames", "--cell", "look.yaml", "--json")
    told = json.loads(line)
    assert told["doc"] == "Says where things are, and sends pictures late."
    assert (told["cell"], told["state"], told["restarts"]) == ("look", "ready", 0)
    assert told["pid"] > 1
    assert told["reads"] == ["gripper/state"]
    assert told["writes"] == ["camera/image_raw", "tf", "tf_static"]
    assert told["calls"] == ["motion/stop"]
    (parameter,) = told["parameters"]
    assert (parameter["path"], parameter["value"], parameter["minimum"]) == ("services.frames.width", 4, 1)


def test_graph_shows_who_is_alive(place: Place) -> None:
    done = place.ask("graph", "look.yaml", "-o", "look.svg")  # what services print while they are wired is on stderr
    assert done.returncode == 0
    (line,) = done.stdout.splitlines()
    assert line.endswith(", 3 services alive")
    drawing = ET.parse(place.folder / "look.svg")
    assert "green: alive; dashed and grey: not alive" in [each.text for each in drawing.iter() if each.text]


@pytest.mark.parametrize(("arguments", "code", "message"), [
    (["tf", "echo", "world", "hnad", "--once"], 2, "unknown frame 'hnad' (did you mean 'hand'?); choices: base, cart"),
    (["tf", "echo", "world", "cart", "--once"], 2, "the root of one is 'world', of the other 'map'"),
    (["tf", "frames", "--cell", "other"], 1, "nothing came on other/tf and other/tf_static"),
    (["topic", "delay", "camera/image_rwa", "-n", "1"], 2, "did you mean 'camera/image_raw'?"),
])
def test_what_goes_wrong_is_one_line(place: Place, arguments: list[str], code: int, message: str) -> None:
    done = place.ask(*arguments)
    (line,) = done.stderr.splitlines()
    assert message in line
    assert (done.returncode, done.stdout) == (code, "")


def test_doctor_finds_the_cell_and_its_version(place: Place) -> None:
    done = place.ask("doctor", "--json")
    findings = [json.loads(line) for line in done.stdout.splitlines()]
    said = [finding["what"] for finding in findings]
    endpoint = f"tcp/127.0.0.1:{7447 + place.domain}"
    assert f"cell look at {endpoint} has the message version of this tool" in said
    assert any(what.startswith("a cell runs or starts: zencell up look.yaml (") for what in said)
    assert all(finding["remedy"] for finding in findings if finding["level"] != "ok")
