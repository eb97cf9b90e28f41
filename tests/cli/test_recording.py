"""Recording and playing with the real command: Ctrl-C, kills, a full disk, keys on a terminal."""

import json
import os
import pty
import resource
import select
import signal
import subprocess
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from recording.formatting import format_bytes, format_progress, format_result
from recording.keyboard import names_of
from recording.reader import Recording
from recording.sink import RecordingStats
from recording.summary import summarise
from tests.cli.conftest import CELL, make_folder
from tests.harness import PATIENCE, Place, Zencell, ask, command_line, environment, free_domain, place_of
from tests.recording.samples import joints, status, write

Start = Callable[..., Zencell]

CAMERA = '''"""Sends pictures of noise, which no compression makes smaller."""
import asyncio, os
from common import topics
from common.config import Parameters
from common.messages import Image
from common.process.service import main

class Config(Parameters):
    """Nothing."""

async def run(bus, config):
    images = bus.writer(topics.CAMERA_IMAGE)
    await bus.ready()
    while True:
        data = os.urandom(64 * 64 * 3)
        images.put(Image(header=bus.header("camera"), height=64, width=64, encoding="bgr8", data=data))
        await asyncio.sleep(0.02)

if __name__ == "__main__":
    main(run, Config)
'''


class Recorded(Place):
    """A cell that is up and sends pictures."""

    def record(self, name: str, *arguments: str) -> Zencell:
        """A recording under way."""
        command = self.start("record", "-o", name, *arguments)
        command.until("recording talk to")
        return command


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recorded]:
    folder = make_folder(tmp_path_factory.mktemp("recording"))
    (folder / "fakes" / "camera_simulator.py").write_text(CAMERA)
    cell = CELL.replace("fakes.first", "fakes.camera_simulator").replace("cell: tiny", "cell: talk")
    (folder / "talk.yaml").write_text(cell)
    with place_of(folder, "talk.yaml", "--seed", "5", "--set", "services.last.placed=2") as up:
        yield Recorded(up.folder, up.domain)


def until_it_holds(path: Path, wanted: Callable[[Recording], bool]) -> None:
    """Return when a recording that is being written has what is wanted."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if path.exists():
            with Recording(path) as recording:
                if wanted(recording):
                    return
        time.sleep(0.05)
    raise AssertionError(f"{path} never held what was waited for")


def of(topic: str) -> Callable[[Recording], bool]:
    return lambda recording: any(recording.samples(lambda each: each == topic))


def pictures(least: int) -> Callable[[Recording], bool]:
    return lambda recording: sum(1 for s in recording.samples(lambda topic: topic == "camera/image_raw")) >= least


def test_ctrl_c_ends_a_recording_that_has_everything_from_the_start(place: Recorded) -> None:
    command = place.record("all.mcap")
    until_it_holds(place.folder / "all.mcap", pictures(5))
    until_it_holds(place.folder / "all.mcap", of("counters/camera_simulator"))  # which come once a second
    command.interrupt()
    assert command.end() == 0, command.lines
    assert any(line.startswith("recorded ") and line.endswith(": all.mcap") for line in command.lines)
    with Recording(place.folder / "all.mcap") as recording:
        summary = summarise(recording)
        first = {sample.topic: sample for sample in reversed(list(recording.samples()))}
    assert summary.finished and summary.about["cell"] == "talk"
    assert summary.run == {"speed": 1.0, "epoch": summary.run["epoch"], "seed": 5, "world": "",
                           "overrides": ["services.last.placed=2"]}
    said = {"camera/image_raw", "pick_place_status", "supervisor/status", "counters/camera_simulator"}
    assert said <= summary.topics.keys()
    state = first["pick_place_status"]  # was said long before
    assert state.kind == "state" and summary.topics["pick_place_status"].messages == 1
    image = first["camera/image_raw"]
    assert (image.message, image.kind, image.writer.partition(".")[0]) == ("Image", "stream", "camera_simulator")
    assert image.sequence > 0 and len(image.trace) == 16
    assert 0 < image.log_time - image.publish_time < PATIENCE * 1e9


def test_only_what_is_wanted_is_recorded_for_the_time_that_is_wanted(place: Recorded) -> None:
    done = place.ask("record", "camera/image_raw", "--regex", "^pick", "--exclude", "counters", "-o", "some.mcap",
                     "--duration", "0.5")
    assert done.returncode == 0, done.stderr
    info = place.folder / "some.mcap"
    shown = json.loads(ask(place.folder, "info", str(info), "--json").stdout)
    assert set(shown["topics"]) == {"camera/image_raw", "pick_place_status"}
    assert shown["run"]["seed"] == 5
    lines = ask(place.folder, "info", str(info)).stdout.splitlines()
    assert lines[0].startswith(f"{info}: talk, ")
    assert any(line.split()[:2] == ["camera/image_raw", "Image"] for line in lines)


def test_killed_recorder_leaves_what_recover_makes_whole(place: Recorded) -> None:
    path = place.folder / "killed.mcap"
    command = place.record("killed.mcap")
    until_it_holds(path, pictures(10))
    command.process.kill()
    command.end()
    info = ask(place.folder, "info", "killed.mcap")
    assert info.returncode == 0 and "not finished" in info.stdout
    assert "zencell recover killed.mcap" in info.stdout
    done = ask(place.folder, "recover", "killed.mcap")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("saved ") and "killed_recovered.mcap" in done.stdout
    with Recording(place.folder / "killed_recovered.mcap") as recording:
        assert recording.finished and pictures(10)(recording)


@pytest.mark.slow
def test_full_disk_stops_the_recording_with_one_line(place: Recorded) -> None:
    def little_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, 500_000))

    done = subprocess.run(
        command_line("record", "-o", "full.mcap", "--domain", str(place.domain)), cwd=place.folder,
        env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False, preexec_fn=little_room,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "zencell: full.mcap: recording stopped, the disk is full; to use what was written: zencell recover full.mcap"]
    recovered = ask(place.folder, "recover", "full.mcap", "-o", "kept.mcap")
    assert recovered.returncode == 0 and "lost nothing" in recovered.stdout
    with Recording(place.folder / "kept.mcap") as recording:
        assert recording.topics()


def test_played_recording_is_new_to_readers_and_its_states_can_be_asked_for(place: Recorded) -> None:
    command = place.record("again.mcap", "camera/*", "pick_pl*")
    until_it_holds(place.folder / "again.mcap", pictures(5))
    command.interrupt()
    assert command.end() == 0
    with Recording(place.folder / "again.mcap") as recording:
        recorded = list(recording.samples())
    heard = place.record("heard.mcap", "--regex", "^test/")
    done = place.ask("play", "again.mcap", "--remap", "camera/image_raw:=test/image", "--remap",
                     "pick_place_status:=test/status", "--rate", "2")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == f"played {len(recorded)} messages"
    until_it_holds(place.folder / "heard.mcap", lambda r: len(list(r.samples())) >= len(recorded))
    heard.interrupt()
    assert heard.end() == 0
    with Recording(place.folder / "heard.mcap") as recording:
        came = list(recording.samples())
    for topic, heard_as in (("camera/image_raw", "test/image"), ("pick_place_status", "test/status")):
        payloads = [sample.payload for sample in recorded if sample.topic == topic]
        assert [sample.payload for sample in came if sample.topic == heard_as] == payloads  # the stamps too
    assert {sample.writer.partition(".")[0] for sample in came} == {"player"}


def test_play_says_who_else_writes_the_same(place: Recorded) -> None:
    write(place.folder / "twice.mcap", [joints(0, key="panda/camera/image_raw"), joints(1)])
    done = place.ask("play", "twice.mcap", "--cell", "talk", "--wait", "camera_simulator")
    assert done.returncode == 0
    assert done.stderr.splitlines() == [
        "camera_simulator is up and publishes camera/image_raw too: subscribers receive both"]


def test_play_needs_neither_cell_nor_router_and_loops_until_ctrl_c(tmp_path: Path, zencell: Start) -> None:
    write(tmp_path / "a.mcap", [f(n) for n in range(20) for f in (joints, status)])
    command = zencell("play", str(tmp_path / "a.mcap"), "--loop", "--topics", "joint_states", "pick_place_status",
                      "--stamp-now")
    assert "a router of its own" in command.until("playing")
    domain = ("--domain", str(command.domain), "--cell", "panda")
    echoed = ask(tmp_path, "topic", "echo", "pick_place_status", "-n", "25", "--json", *domain)
    values = [json.loads(line) for line in echoed.stdout.splitlines()]
    assert len(values) == 25, echoed.stderr  # more than were recorded
    assert all(abs(value["header"]["stamp"] * 1e-9 - time.time()) < PATIENCE for value in values)
    command.interrupt()
    assert command.end() == 130
    assert command.lines[-2].startswith("played ") or command.lines[-1].startswith("played ")


@pytest.mark.slow
def test_keys_pause_step_and_quit_and_the_terminal_is_given_back(tmp_path: Path) -> None:
    samples = [joints(n, key="panda/a") for n in range(1, 2000)]
    write(tmp_path / "a.mcap", samples, every=100)
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    process = subprocess.Popen(
        command_line("play", "a.mcap", "--start-paused", "--domain", str(free_domain())), cwd=tmp_path,
        env={**environment(), "TERM": "xterm"}, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
    )
    seen = b""

    def until(text: bytes) -> None:
        nonlocal seen
        deadline = time.monotonic() + PATIENCE
        while text not in seen:
            assert time.monotonic() < deadline, seen[-500:]
            if select.select([ours], [], [], 0.1)[0]:
                seen += os.read(ours, 4096)
        seen = seen.partition(text)[2]

    try:
        until(b"space: pause")
        until(b"paused  0 messages")
        assert not termios.tcgetattr(theirs)[3] & termios.ICANON
        os.write(ours, b"\x1b[C")
        until(b"paused  1 messages")
        os.write(ours, b"\x1b[C")
        until(b"paused  2 messages")
        os.write(ours, b" ")
        until(b"x1")
        os.write(ours, b" ")
        until(b"paused")
        os.write(ours, b"\x1b[D")  # back to the start
        until(b"0.0 / 20.0 s  paused")
        os.write(ours, b"q")
        until(b"played ")
        assert process.wait(PATIENCE) == 0
        assert termios.tcgetattr(theirs) == before
    finally:
        process.kill()
        process.wait()
        os.close(ours)
        os.close(theirs)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_terminal_is_given_back_after_a_signal(tmp_path: Path, number: int) -> None:
    write(tmp_path / "a.mcap", [joints(n) for n in range(5)])
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    process = subprocess.Popen(
        command_line("play", "a.mcap", "--start-paused", "--domain", str(free_domain())), cwd=tmp_path,
        env=environment(), stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
    )
    try:
        seen = b""
        while b"paused  0" not in seen:
            assert select.select([ours], [], [], PATIENCE)[0], seen
            seen += os.read(ours, 4096)
        process.send_signal(number)
        assert process.wait(PATIENCE) == 128 + number
        assert termios.tcgetattr(theirs) == before
    finally:
        process.kill()
        process.wait()
        os.close(ours)
        os.close(theirs)


def test_run_records_from_before_its_services_are_ready_to_after_their_end(zencell: Start, folder: Path) -> None:
    command = zencell("run", "tiny.yaml", "--set", "services.last.behave=done", "--record", "run.mcap", "--seed", "9")
    assert command.end() == 0, command.lines
    assert any("recorded " in line and "run.mcap" in line for line in command.lines), command.lines
    said = [line for line in command.lines if "hello from" in line or "recording tiny" in line]
    assert said[0].startswith("recorder: recording tiny")
    command.until_childless()
    with Recording(folder / "run.mcap") as recording:
        assert recording.finished
        assert recording.metadata("run")["seed"] == 9
        names = {sample.topic for sample in recording.samples()}
        lines = b" ".join(s.payload for s in recording.samples(lambda topic: topic.startswith("log/")))
    assert {"pick_place_status", "supervisor/status"} <= names
    assert b"stopped: SIGTERM" in lines


@pytest.mark.slow
def test_run_goes_on_when_its_recorder_dies(zencell: Start, folder: Path) -> None:
    command = zencell("up", "tiny.yaml", "--record", "run.mcap")
    command.until("zenoh --mode client")
    command.children()["main"].kill()
    command.until("recorder ended (killed by SIGKILL)")
    assert sorted(command.children()) == ["first", "last", "middle", "router"]
    command.interrupt()
    assert command.end() == 0


BAD = [
    (("record", "motion/plan"), "unknown published key 'motion/plan'"),
    (("record", "a b"), "KEY: 'a b' is not a key"),
    (("record", "--regex", "["), "--regex: '[' is not a regular expression"),
    (("record", "--duration", "0"), "--duration: '0' must be more than 0"),
    (("record", "--max-size", "0.1"), "--max-size: '0.1' must be 1 or more"),
    (("record", "-o", "there.mcap"), "exists already; choose another name"),
    (("record", "-o", "no/such/a.mcap"), "is in a folder that does not exist"),
    (("record", "-o", "a.bag"), "must end in .mcap"),
    (("info", "none.mcap"), "none.mcap: no such file"),
    (("info", "tiny.yaml"), "tiny.yaml: is no MCAP file"),
    (("recover", "there.mcap", "-o", "there.mcap"), "exists already"),
    (("play", "there.mcap", "--rate", "0"), "--rate: '0' must be more than 0"),
    (("play", "there.mcap", "--rate", "fast"), "--rate: 'fast' must be a number"),
    (("play", "there.mcap", "--start-offset", "99"), "--start-offset: '99' must be 0 to 0.1"),
    (("play", "there.mcap", "--remap", "a=b"), "--remap: 'a=b' must be FROM:=TO"),
    (("play", "there.mcap", "camera/image_raw"), "is not in there.mcap; choices: joint_states"),
    (("play", "there.mcap", "--exclude", "."), "has no message of the selected topics"),
    (("play", "there.mcap", "--start-paused"), "--start-paused: needs a terminal"),
    (("export", "there.mcap"), "needs one or more of --foxglove"),
    (("export", "there.mcap", "--video", "v.mp4"), "needs one topic with images"),
    (("export", "there.mcap", "--csv", "there.mcap"), "--csv: 'there.mcap' must be a folder"),
    (("export", "there.mcap", "--csv", "d", "--topics", "tf"), "--topics: 'tf' is not in there.mcap; choices: joint"),
    (("run", "tiny.yaml", "--record", "there.mcap"), "--record: "),
]


@pytest.mark.parametrize(("arguments", "said"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_bad_input_is_one_line(
    arguments: tuple[str, ...], said: str, folder: Path, monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    from cli.main import app

    write(folder / "there.mcap", [joints(n) for n in range(12)])
    monkeypatch.chdir(folder)
    assert app.execute([*arguments]) == 2
    shown = capfd.readouterr()
    assert said in shown.err and shown.err.count("\n") == 1
    assert shown.out == ""


def test_export_says_what_it_wrote(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", [f(n) for n in range(3) for f in (joints, status)])
    done = ask(tmp_path, "export", "a.mcap", "--csv", "tables", "--foxglove", "f.mcap")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[1:] == ["tables/joint_states.csv: 3 rows", "tables/pick_place_status.csv: 3 rows"]
    assert done.stdout.startswith("f.mcap: 6 messages, ")


def test_keys_are_told_apart_and_unknown_sequences_are_none() -> None:
    assert names_of(b" q\x1b[C\x1b[D\x1b[Bx") == ["space", "q", "right", "left", "down", "x"]
    assert names_of(b"\x1b[1;5C") == []
    assert names_of(b"\x1b") == []


def test_lines_for_people() -> None:
    before, now = RecordingStats(10, 1000, 1.0), RecordingStats(1234, 2_001_000, 2.0, {"panda/tf": 3})
    assert format_progress(now, before, 2) == "   2.0 s  1,234 messages  2.0 MB  2.0 MB/s  5 lost"
    assert format_result(["a_0.mcap", "a_1.mcap"], now, {"panda/log": 1}) == [
        "recorded 1,234 messages, 2.0 MB, 2.0 s: a_0.mcap to a_1.mcap",
        "  panda/tf: 3 dropped, the disk was too slow, or there were too many keys",
        "  panda/log: 1 lost on the network"]
    assert format_result(["a.mcap"], before, {})[1] == "no message was lost"
    assert [format_bytes(n) for n in (5, 5e3, 5e6, 5e9)] == ["5 B", "5.0 kB", "5.0 MB", "5.0 GB"]
