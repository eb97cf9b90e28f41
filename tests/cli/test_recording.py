"""Record, recover and play with the real command: Ctrl-C, kills, a full disk, keys on a terminal."""

import json
import os
import pty
import select
import signal
import subprocess
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from recording.capture import RecordingStats
from recording.formatting import format_bytes, format_progress, format_result
from recording.keyboard import names_of
from recording.reader import Recording
from recording.summary import summarise
from tests.cli.conftest import make_folder
from tests.harness import PATIENCE, Place, Zencell, ask, command_line, environment, free_domain, place_of
from tests.recording.samples import joints, status, write

Start = Callable[..., Zencell]
IMAGE = "camera/image_raw"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = make_folder(tmp_path_factory.mktemp("recording"), "talk", "talker")
    with place_of(folder, "talk.yaml", "--seed", "5", "--set", "services.last.placed=2") as place:
        yield place


def record(place: Place, name: str, *arguments: str) -> Zencell:
    command = place.start("record", "-o", name, *arguments)
    command.until("recording talk to")
    return command


def wait_for(path: Path, topic: str = "", messages: int = 1) -> None:
    """Wait until a recording that is being written has so many messages of a topic, or of all."""
    deadline = time.monotonic() + PATIENCE
    found = -1
    while found < messages:
        assert time.monotonic() < deadline, f"{path} has {found} messages of {topic}"
        time.sleep(0.05)
        if path.exists():
            with Recording(path) as recording:
                found = sum(1 for _ in recording.samples(lambda each: topic in ("", each)))


def test_recording_ended_by_ctrl_c_is_complete_from_the_first_state_on(place):
    command = record(place, "all.mcap")
    wait_for(place.folder / "all.mcap", IMAGE, 5)
    for topic in ("counters/talker", "pick_place_status", "supervisor/status"):  # published once a second
        wait_for(place.folder / "all.mcap", topic)
    command.interrupt()
    assert command.end() == 0, command.lines
    assert any(line.startswith("recorded ") and line.endswith(": all.mcap") for line in command.lines)
    with Recording(place.folder / "all.mcap") as recording:
        summary = summarise(recording)
        first = {sample.topic: sample for sample in reversed(list(recording.samples()))}
    assert summary.finished and summary.about["cell"] == "talk"
    assert summary.run == {"speed": 1.0, "epoch": summary.run["epoch"], "seed": 5, "world": "",
                           "overrides": ["services.last.placed=2"]}
    assert {IMAGE, "pick_place_status", "supervisor/status", "counters/talker"} <= summary.topics.keys()
    state = first["pick_place_status"]  # published long before
    assert state.kind == "state" and summary.topics["pick_place_status"].messages == 1
    image = first[IMAGE]
    assert (image.message, image.kind, image.writer.partition(".")[0]) == ("Image", "stream", "talker")
    assert image.sequence > 0 and len(image.trace) == 16
    assert 0 < image.log_time - image.publish_time < PATIENCE * 1e9


def test_selected_topics_are_recorded_for_a_duration(place):
    done = place.ask("record", IMAGE, "--regex", "^pick", "--exclude", "counters", "-o", "some.mcap",
                     "--duration", "3")  # states are repeated each second
    assert done.returncode == 0, done.stderr
    shown = json.loads(ask(place.folder, "info", "some.mcap", "--json").stdout)
    assert set(shown["topics"]) == {IMAGE, "pick_place_status"} and shown["run"]["seed"] == 5
    lines = ask(place.folder, "info", "some.mcap").stdout.splitlines()
    assert lines[0].startswith("some.mcap: talk, ")
    assert any(line.split()[:2] == [IMAGE, "Image"] for line in lines)


def test_recording_of_a_killed_recorder_can_be_recovered(place):
    command = record(place, "killed.mcap")
    wait_for(place.folder / "killed.mcap", IMAGE, 10)
    command.process.kill()
    command.end()
    info = ask(place.folder, "info", "killed.mcap")
    assert info.returncode == 0 and "not finished" in info.stdout and "zencell recover killed.mcap" in info.stdout
    done = ask(place.folder, "recover", "killed.mcap")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("saved ") and "killed_recovered.mcap" in done.stdout
    with Recording(place.folder / "killed_recovered.mcap") as recording:
        assert recording.finished and len(list(recording.samples(lambda topic: topic == IMAGE))) >= 10


def test_played_recording_is_received_under_other_keys_with_its_payloads_unchanged(place):
    command = record(place, "again.mcap", "camera/*", "pick_pl*")
    wait_for(place.folder / "again.mcap", IMAGE, 5)
    command.interrupt()
    assert command.end() == 0
    with Recording(place.folder / "again.mcap") as recording:
        recorded = list(recording.samples())
    second = record(place, "second.mcap", "--regex", "^test/")
    done = place.ask("play", "again.mcap", "--remap", f"{IMAGE}:=test/image", "--remap",
                     "pick_place_status:=test/status", "--rate", "2")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == f"played {len(recorded)} messages"
    wait_for(place.folder / "second.mcap", messages=len(recorded))
    second.interrupt()
    assert second.end() == 0
    with Recording(place.folder / "second.mcap") as recording:
        received = list(recording.samples())
    for topic, remapped in ((IMAGE, "test/image"), ("pick_place_status", "test/status")):
        payloads = [sample.payload for sample in recorded if sample.topic == topic]
        assert [sample.payload for sample in received if sample.topic == remapped] == payloads  # the stamps too
    assert {sample.writer.partition(".")[0] for sample in received} == {"player"}


def test_play_warns_of_another_publisher_of_its_topics(place):
    write(place.folder / "twice.mcap", [joints(0, key=f"panda/{IMAGE}"), joints(1)])
    done = place.ask("play", "twice.mcap", "--cell", "talk", "--wait", "talker")
    assert done.returncode == 0
    assert done.stderr.splitlines() == [f"talker is up and publishes {IMAGE} too: subscribers receive both"]


def test_play_needs_no_router_and_loops_until_ctrl_c(tmp_path, zencell):
    write(tmp_path / "a.mcap", [f(n) for n in range(20) for f in (joints, status)])
    command = zencell("play", "a.mcap", "--loop", "--topics", "joint_states", "pick_place_status", "--stamp-now")
    assert "a router of its own" in command.until("playing")
    echo = ask(tmp_path, "topic", "echo", "pick_place_status", "-n", "25", "--json",
               "--domain", str(command.domain))
    values = [json.loads(line) for line in echo.stdout.splitlines()]
    assert len(values) == 25, echo.stderr  # more than were recorded
    assert all(abs(value["header"]["stamp"] * 1e-9 - time.time()) < PATIENCE for value in values)
    command.interrupt()
    assert command.end() == 130
    assert any(line.startswith("played ") for line in command.lines[-2:])


@contextmanager
def playing_on_a_terminal(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], int, Callable[[bytes], None]]]:
    """Start a paused player on a terminal whose settings must be restored at the end of the block."""
    write(folder / "a.mcap", [joints(n, key="panda/a") for n in range(1, 2000)], every=100)
    ours, theirs = pty.openpty()
    before, seen = termios.tcgetattr(theirs), b""

    def until(text: bytes) -> None:
        nonlocal seen
        while text not in seen:
            assert select.select([ours], [], [], PATIENCE)[0], seen[-500:]
            seen += os.read(ours, 4096)
        seen = seen.partition(text)[2]

    process = subprocess.Popen(
        command_line("play", "a.mcap", "--start-paused", "--domain", str(free_domain())), cwd=folder,
        env={**environment(), "TERM": "xterm"}, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    try:
        until(b"paused  0 messages")
        assert not termios.tcgetattr(theirs)[3] & termios.ICANON
        yield process, ours, until
        assert termios.tcgetattr(theirs) == before
    finally:
        process.kill()
        process.wait()
        os.close(ours)
        os.close(theirs)


@pytest.mark.slow
def test_keys_step_pause_jump_and_quit(tmp_path):
    with playing_on_a_terminal(tmp_path) as (process, terminal, until):
        for key, shown in ((b"\x1b[C", b"paused  1 messages"), (b"\x1b[C", b"paused  2 messages"), (b" ", b"x1"),
                           (b" ", b"paused"), (b"\x1b[D", b"0.0 / 20.0 s  paused"), (b"q", b"played ")):
            os.write(terminal, key)
            until(shown)
        assert process.wait(PATIENCE) == 0


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_terminal_is_restored_after_a_signal(tmp_path, number):
    with playing_on_a_terminal(tmp_path) as (process, _, _):
        process.send_signal(number)
        assert process.wait(PATIENCE) == 128 + number


def test_run_records_from_before_its_services_are_ready_to_after_their_end(zencell, folder):
    command = zencell("run", "tiny.yaml", "--set", "services.last.behave=done", "--record", "run.mcap", "--seed", "9")
    assert command.end() == 0, command.lines
    assert any("recorded " in line and "run.mcap" in line for line in command.lines), command.lines
    starts = [line for line in command.lines if "hello from" in line or "recording tiny" in line]
    assert starts[0].startswith("recorder: recording tiny")
    command.until_childless()
    with Recording(folder / "run.mcap") as recording:
        assert recording.finished and recording.metadata("run")["seed"] == 9
        assert {"pick_place_status", "supervisor/status"} <= {sample.topic for sample in recording.samples()}
        logged = b" ".join(s.payload for s in recording.samples(lambda topic: topic.startswith("log/")))
    assert b"stopped: SIGTERM" in logged


@pytest.mark.slow
def test_cell_survives_its_recorder(zencell):
    command = zencell("up", "tiny.yaml", "--record", "run.mcap")
    command.until("zenoh --mode client")
    command.children()["main"].kill()
    command.until("recorder ended (killed by SIGKILL)")
    assert sorted(command.children()) == ["first", "last", "middle", "router"]
    command.interrupt()
    assert command.end() == 0


def test_export_lists_the_written_files(tmp_path):
    write(tmp_path / "a.mcap", [f(n) for n in range(3) for f in (joints, status)])
    done = ask(tmp_path, "export", "a.mcap", "--csv", "tables", "--foxglove", "f.mcap")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[1:] == ["tables/joint_states.csv: 3 rows", "tables/pick_place_status.csv: 3 rows"]
    assert done.stdout.startswith("f.mcap: 6 messages, ")


def test_escape_sequences_of_keys_are_named():
    assert names_of(b" q\x1b[C\x1b[D\x1b[Bx") == ["space", "q", "right", "left", "down", "x"]
    assert names_of(b"\x1b[1;5C") == names_of(b"\x1b") == []


def test_progress_and_result_are_formatted():
    before, now = RecordingStats(10, 1000, 1.0), RecordingStats(1234, 2_001_000, 2.0, {"panda/tf": 3})
    assert format_progress(now, before, 2) == "   2.0 s  1,234 messages  2.0 MB  2.0 MB/s  5 lost"
    assert format_result(["a_0.mcap", "a_1.mcap"], now, {"panda/log": 1}) == [
        "recorded 1,234 messages, 2.0 MB, 2.0 s: a_0.mcap to a_1.mcap",
        "  panda/tf: 3 dropped, the disk was too slow, or there were too many keys",
        "  panda/log: 1 lost on the network"]
    assert format_result(["a.mcap"], before, {})[1] == "no message was lost"
    assert [format_bytes(n) for n in (5, 5e3, 5e6, 5e9)] == ["5 B", "5.0 kB", "5.0 MB", "5.0 GB"]
