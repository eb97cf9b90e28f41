"""A recording is a file of somebody else's: what is in it costs its reader no more than it looks, opens nothing, and
is told in one line."""

import json
import re
import resource
import struct
import time
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.writer import MCAP0_MAGIC

from cli.main import app
from common.messages import Header, Image, JointState, LogLine
from recording.export import file_names
from recording.writer import RUN, RecordingWriter
from tests.recording.samples import joints, packed, status

STEERING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]")
EVIL = "\x1b]0;owned\x07\x9b2J[/x]<script>alert(1)</script>\u202e"
WITHIN = 1.0  # [s of processor time]
MEMORY = 300_000  # [kB] more than before
VERBS = ("info", "play", "report", "export", "recover")


@pytest.fixture(autouse=True)
def warm() -> None:
    """What the verbs import is no part of what a recording costs."""
    import recording.foxglove
    import recording.reader
    import recording.report.build  # noqa: F401


def verb(name: str, path: Path) -> list[str]:
    more = {"export": ["--csv", str(path.parent / "tables"), "--images", str(path.parent / "pictures")],
            "recover": ["-o", str(path.with_name("saved.mcap"))]}
    if name == "recover":
        path.with_name("saved.mcap").unlink(missing_ok=True)
    return [name, str(path), *more.get(name, [])]


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def chunk(contents: bytes, compression: str, size: int) -> bytes:
    head = struct.pack("<QQQI", 1, 2, size, 0) + text(compression)
    return record(0x06, head + struct.pack("<Q", len(contents)) + contents)


def channel(number: int) -> bytes:
    return record(0x04, struct.pack("<HH", number % 65536, 0) + text(f"panda/{number}") + text("msgpack") + text(""))


HEADER = record(0x01, text("zencell") + text("t"))
ABOUT = record(0x0C, text("zencell") + struct.pack("<I", 22) + text("cell") + text("panda") + b"\0" * 5)
NOTHING = bytes(64_000_000)
MESSAGE = record(0x05, struct.pack("<HIQQ", 1, 1, 1, 1) + bytes(40_000_000))
BOMBS: dict[str, Callable[[], bytes]] = {
    "a chunk that says it is huge": lambda: chunk(zstandard.compress(b"x"), "zstd", 2**62),
    "a chunk that is larger than it says": lambda: chunk(zstandard.compress(NOTHING), "zstd", 1000),
    "a chunk of nothing": lambda: chunk(zstandard.compress(NOTHING[:48_000_000]), "zstd", 48_000_000),
    "the same in lz4": lambda: chunk(lz4.frame.compress(NOTHING), "lz4", 1000),
    "lz4 that says it is huge": lambda: chunk(lz4.frame.compress(NOTHING), "lz4", 2**40),
    "many messages of nothing": lambda: 1000 * chunk(zstandard.compress(MESSAGE), "zstd", len(MESSAGE)),
    "very many tiny messages": lambda: chunk(
        zstandard.compress(200_000 * record(0x05, struct.pack("<HIQQ", 1, 1, 1, 1))), "zstd", 6_200_000),
    "very many channels": lambda: b"".join(map(channel, range(200_000))),
    "very many channels in a chunk": lambda: chunk(
        zstandard.compress(b"".join(map(channel, range(200_000)))), "zstd",
        sum(len(channel(n)) for n in range(200_000))),
    "metadata of 100 MB": lambda: record(0x0C, text("run") + struct.pack("<I", 100_000_000) + bytes(100_000_000)),
    "records of nothing": lambda: 5_000_000 * record(0x81, b""),
    "another compression": lambda: chunk(b"x" * 1000, "brotli", 10**6),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_at_once(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MCAP0_MAGIC + HEADER + BOMBS[name]())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for each in VERBS:
        before = time.process_time()
        code = app.execute(verb(each, path))
        assert time.process_time() - before < WITHIN, each
        said = capsys.readouterr()
        lines = said.err.splitlines() if each != "recover" or code else said.out.splitlines()
        assert len(lines) == 1, said
        if each == "recover" and not code:
            assert "damaged chunks" in lines[0]
            assert "saved 0 messages" in lines[0]
        else:
            assert code == 2
            assert str(path) in lines[0]
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak < MEMORY


def told(path: Path, about: dict[str, object] | None = None, ended: dict[str, object] | None = None,
         **run: object) -> Path:
    """A small recording of a run that tells what it likes of itself."""
    writer = RecordingWriter(path, {"cell": "panda", "made": "today", **(about or {})})
    writer.describe(RUN, {"speed": 1.0, "epoch": 0, "seed": 7, "world": "", "overrides": [], **run})
    for number in range(20):
        writer.add(joints(number))
        writer.add(status(number))
    writer.close({"reason": "test", **(ended or {})})
    return path


@pytest.mark.parametrize("wrong", [
    {"speed": "fast"}, {"speed": 0.0 - 1}, {"speed": "NaN"}, {"speed": [1]}, {"speed": 1e300}, {"epoch": "then"},
    {"epoch": 10**30}, {"seed": {"a": 1}}, {"world": 7}, {"overrides": "robot=x"}, {"overrides": [1]},
    {"overrides": ["a=1"] * 100_000}, {"speed": "[" * 100_000},
    {"about": {"cell": "../../etc"}}, {"about": {"cell": ["panda"]}}, {"about": {"cell": EVIL}},
    {"about": {"cell": "**"}}, {"ended": {"missed": [1]}}, {"ended": {"dropped": {"panda/tf": "many"}}},
], ids=lambda wrong: str(wrong)[:40])
def test_metadata_that_cannot_be_is_one_line(
    wrong: dict[str, object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = told(tmp_path / "run.mcap", **wrong)  # type: ignore[arg-type]
    assert app.execute(["report", str(path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "which is not" in lines[0]
    assert not STEERING.search(lines[0])
    for each in ("info", "export", "recover"):
        app.execute(verb(each, path))
        said = capsys.readouterr()
        assert len(said.err.splitlines()) <= 1
        assert not STEERING.search(said.err + said.out)


@pytest.mark.parametrize("names", [
    {"world": "{folder}/secret.yaml"}, {"world": "../../secret"}, {"overrides": ["@{folder}/secret.yaml"]},
    {"overrides": ["robot={folder}/secret.yaml"]}, {"overrides": ["robot.urdf={folder}/secret.yaml"]},
    {"overrides": ["application=secret.module"]}, {"overrides": ["services.x.module=secret.module"]},
    {"overrides": ["world={{a: &a [1], b: *a}}"]}, {"about": {"cell": "secret.yaml"}},
], ids=str)
@pytest.mark.slow
def test_no_file_is_read_that_a_recording_names(
    names: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    filled = json.loads(json.dumps(names).replace("{folder}", str(tmp_path)))
    path = told(tmp_path / "run.mcap", **filled)
    (tmp_path / "secret.yaml").mkdir()  # a folder: who tries to read it fails
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "module.py").write_text("raise SystemExit('was run')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    opened: list[str] = []
    from common.config import files

    read = files.read_yaml
    monkeypatch.setattr("common.config.loading.read_yaml", lambda file: (opened.append(str(file)), read(file))[1])
    assert app.execute(["report", str(path)]) == 0, capsys.readouterr().err
    assert not [file for file in opened if "secret" in file]
    page = path.with_suffix(".html").read_text()
    assert "a file named in a recording is not read" in page or "missing, since the cell is not installed" in page


TOPICS = ["..", "../../up", "/etc/passwd", ".hidden", "a/b", "a_b", "nul\0", "x" * 300, EVIL, "", "con/../../x"]


@pytest.mark.parametrize("kind", ["--csv", "--images"])
def test_an_export_stays_in_its_folder(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = packed(Image(header=Header(stamp=1), height=2, width=2, encoding="mono8", step=2, data=b"abcd"))
    writer = RecordingWriter(tmp_path / "run.mcap", {"cell": "panda"})
    for number, topic in enumerate(TOPICS):
        made = joints(number, key=f"panda/{topic}")
        writer.add(made if kind == "--csv" else joints(number, key=f"panda/{topic}", payload=picture, message="Image"))
    writer.close({})
    target = tmp_path / "deep" / "target"
    target.mkdir(parents=True)
    assert app.execute(["export", str(tmp_path / "run.mcap"), kind, str(target)]) == 0
    assert len(list(target.iterdir())) == len(TOPICS)
    assert {path.name for path in tmp_path.iterdir()} == {"run.mcap", "deep"}
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["target"]
    assert not STEERING.search(capsys.readouterr().out)


def test_names_of_files_are_those_of_the_topics_where_they_can_be() -> None:
    assert file_names(["camera/image_raw", "tf_static"]) == {
        "camera/image_raw": "camera_image_raw", "tf_static": "tf_static"}
    assert len(set(file_names(TOPICS).values())) == len(TOPICS)


@pytest.mark.parametrize("topic", ["**", "a/*", "a//b", "/a", "a?b", "", "../up", "a\x1b"])
def test_what_is_no_key_is_not_played(topic: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", {"cell": "panda"})
    writer.add(joints(0, key=f"panda/{topic}"))
    writer.close({})
    assert app.execute(["play", str(tmp_path / "run.mcap")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "which is not a key" in lines[0]


def test_text_of_a_recording_steers_neither_terminal_nor_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, {"cell": "panda", "made": EVIL, "versions": {"zencell": EVIL}})
    writer.describe(RUN, {"overrides": [EVIL], "world": EVIL, EVIL: EVIL})
    for number in range(5):
        writer.add(joints(number))
    line = LogLine.model_construct(header=Header(stamp=1), service=EVIL,
                                   level="error", message=EVIL)
    writer.add(joints(6, key="panda/log", payload=packed(line), message="LogLine", kind="event"))
    writer.add(joints(7, key=f"panda/{EVIL}", message=EVIL, schema=b"{}"))
    writer.close({"missed": {f"panda/{EVIL}": 3}})
    for each in ("info", "report", "export", "recover"):
        app.execute(verb(each, path))
        said = capsys.readouterr()
        assert not STEERING.search(said.out + said.err), each
    page = path.with_suffix(".html").read_text()
    assert not STEERING.search(page)
    assert "<script>alert" not in page


def test_numbers_that_no_run_has_are_one_line_at_most(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.mcap"
    for number in (float("nan"), float("inf"), 1e308, -1e308):
        path.unlink(missing_ok=True)
        writer = RecordingWriter(path, {"cell": "panda"})
        values = [number] * 7
        names = [f"panda_joint{k}" for k in range(1, 8)]
        state = JointState.model_construct(header=Header(stamp=1), name=names, position=values,
                                           velocity=values, effort=[])
        for k in range(5):
            writer.add(joints(k, payload=packed(state)))
        writer.add(status(6))
        writer.close({})
        code = app.execute(["report", str(path)])
        lines = capsys.readouterr().err.splitlines()
        assert (code, len(lines)) in ((0, 0), (2, 1)), (number, lines)


@pytest.mark.slow
def test_a_damaged_byte_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = told(tmp_path / "whole.mcap").read_bytes()
    path = tmp_path / "damaged.mcap"
    for at in range(0, len(whole), max(1, len(whole) // 10)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1:])
        for each in ("info", "export", "recover"):
            code = app.execute(verb(each, path))
            said = capsys.readouterr()
            assert code in (0, 2)
            assert len(said.err.splitlines()) <= (1 if code else 20), said.err
