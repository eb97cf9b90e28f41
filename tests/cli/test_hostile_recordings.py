"""The author of a recording is not trusted: reading it is cheap, opens no other file, and controls no terminal."""

import json
import re
import resource
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from mcap.writer import MCAP0_MAGIC

from cli.main import app
from common.config import files
from common.messages import Header, Image, JointState, LogLine
from recording.export import file_names
from recording.sample import Sample
from recording.writer import RUN, RecordingWriter
from tests.recording.samples import joints, packed, status

STEERING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]")
EVIL = "\x1b]0;owned\x07\x9b2J[/x]<script>alert(1)</script>\u202e"
WITHIN = 5.0  # [s of processor time]: reading all messages takes minutes
MEMORY = 300_000  # [kB] more than before
TOPICS = ["..", "../../up", "/etc/passwd", ".hidden", "a/b", "a_b", "nul\0", "x" * 300, EVIL, "", "con/../../x"]


@pytest.fixture(autouse=True)
def warm():
    """Import the modules of the commands, which are no part of what a recording costs."""
    import recording.foxglove
    import recording.reader
    import recording.report.build  # noqa: F401


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


def command(name: str, path: Path) -> list[str]:
    options = {"export": ["--csv", str(path.parent / "tables"), "--images", str(path.parent / "images")],
               "recover": ["-o", str(path.with_name("saved.mcap"))]}
    if name == "recover":
        path.with_name("saved.mcap").unlink(missing_ok=True)
    return [name, str(path), *options.get(name, [])]


def write(path: Path, *samples: Sample, ended: dict[str, Any] | None = None, run: dict[str, Any] | None = None,
          **about: object) -> Path:
    """Write a recording with any metadata."""
    writer = RecordingWriter(path, {"cell": "panda", "made": "today", **about})
    if run is not None:
        writer.describe(RUN, run)
    for sample in samples:
        writer.add(sample)
    writer.close(ended or {})
    return path


def run_with(path: Path, about: dict[str, object] | None = None, ended: dict[str, object] | None = None,
             **run: object) -> Path:
    """Write a small recording of a run with chosen metadata."""
    samples = [sample for number in range(20) for sample in (joints(number), status(number))]
    run = {"speed": 1.0, "epoch": 0, "seed": 7, "world": "", "overrides": [], **run}
    return write(path, *samples, ended={"reason": "test", **(ended or {})}, run=run, **(about or {}))


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def chunk(contents: bytes, compression: str, size: int) -> bytes:
    head = struct.pack("<QQQI", 1, 2, size, 0) + text(compression)
    return record(0x06, head + struct.pack("<Q", len(contents)) + contents)


def packed_chunk(contents: bytes) -> bytes:
    return chunk(zstandard.compress(contents), "zstd", len(contents))


def channels() -> bytes:
    return b"".join(record(0x04, struct.pack("<HH", number % 65536, 0) + text(f"panda/{number}") + text("msgpack")
                           + text("")) for number in range(200_000))


HEADER = record(0x01, text("zencell") + text("t"))
ZEROS = bytes(64_000_000)
MESSAGE = struct.pack("<HIQQ", 1, 1, 1, 1)
BOMBS: dict[str, Callable[[], bytes]] = {
    "chunk that claims to be huge": lambda: chunk(zstandard.compress(b"x"), "zstd", 2**62),
    "chunk that is larger than it claims": lambda: chunk(zstandard.compress(ZEROS), "zstd", 1000),
    "chunk of zeros": lambda: packed_chunk(ZEROS[:48_000_000]),
    "the same in lz4": lambda: chunk(lz4.frame.compress(ZEROS), "lz4", 1000),
    "lz4 that claims to be huge": lambda: chunk(lz4.frame.compress(ZEROS), "lz4", 2**40),
    "many messages of zeros": lambda: 1000 * packed_chunk(record(0x05, MESSAGE + bytes(40_000_000))),
    "very many tiny messages": lambda: packed_chunk(200_000 * record(0x05, MESSAGE)),
    "very many chunks of tiny messages": lambda: (
        record(0x04, struct.pack("<HH", 1, 0) + text("panda/a") + text("msgpack") + struct.pack("<I", 0))
        + 500 * packed_chunk(40_000 * record(0x05, MESSAGE))),
    "very many channels": channels,
    "very many channels in a chunk": lambda: packed_chunk(channels()),
    "metadata of 100 MB": lambda: record(0x0C, text("run") + struct.pack("<I", 100_000_000) + bytes(100_000_000)),
    "records without content": lambda: 5_000_000 * record(0x81, b""),
    "another compression": lambda: chunk(b"x" * 1000, "brotli", 10**6),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_bomb_is_rejected_at_once(name, path, capsys):
    path.write_bytes(MCAP0_MAGIC + HEADER + BOMBS[name]())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for each in ("info", "play", "report", "export", "recover"):
        before = time.process_time()
        code = app.execute(command(each, path))
        assert time.process_time() - before < WITHIN, each
        shown = capsys.readouterr()
        recovered = each == "recover" and not code
        (line,) = (shown.out if recovered else shown.err).splitlines()
        if recovered:
            assert "damaged chunks" in line and "saved 0 messages" in line
        else:
            assert code == 2 and str(path) in line
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak < MEMORY


@pytest.mark.parametrize("wrong", [
    {"speed": "fast"}, {"speed": 0.0 - 1}, {"speed": "NaN"}, {"speed": [1]}, {"speed": 1e300}, {"epoch": "then"},
    {"epoch": 10**30}, {"seed": {"a": 1}}, {"world": 7}, {"overrides": "robot=x"}, {"overrides": [1]},
    {"overrides": ["a=1"] * 100_000}, {"speed": "[" * 100_000},
    {"about": {"cell": "../../etc"}}, {"about": {"cell": ["panda"]}}, {"about": {"cell": EVIL}},
    {"about": {"cell": "**"}}, {"ended": {"missed": [1]}}, {"ended": {"dropped": {"panda/tf": "many"}}},
], ids=lambda wrong: str(wrong)[:40])
def test_invalid_metadata_is_one_line(wrong, path, rejection, capsys):
    line = rejection("report", str(run_with(path, **wrong)))
    assert "which is not" in line and not STEERING.search(line)
    for each in ("info", "recover"):
        app.execute(command(each, path))
        shown = capsys.readouterr()
        assert len(shown.err.splitlines()) <= 1 and not STEERING.search(shown.err + shown.out)


@pytest.mark.parametrize("names", [
    {"world": "{folder}/secret.yaml"}, {"world": "../../secret"}, {"overrides": ["@{folder}/secret.yaml"]},
    {"overrides": ["robot={folder}/secret.yaml"]}, {"overrides": ["robot.urdf={folder}/secret.yaml"]},
    {"overrides": ["application=secret.module"]}, {"overrides": ["services.x.module=secret.module"]},
    {"overrides": ["world={{a: &a [1], b: *a}}"]}, {"about": {"cell": "secret.yaml"}},
], ids=str)
@pytest.mark.slow
def test_no_file_named_in_a_recording_is_read(names, path, monkeypatch, capsys):
    folder = path.parent
    run_with(path, **json.loads(json.dumps(names).replace("{folder}", str(folder))))
    (folder / "secret.yaml").mkdir()  # reading a folder fails
    (folder / "secret").mkdir()
    (folder / "secret" / "module.py").write_text("raise SystemExit('was run')\n")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    opened, read = [], files.read_yaml
    monkeypatch.setattr("common.config.loading.read_yaml", lambda file: (opened.append(str(file)), read(file))[1])
    assert app.execute(["report", str(path)]) == 0, capsys.readouterr().err
    assert not [file for file in opened if "secret" in file]
    page = path.with_suffix(".html").read_text()
    assert "a file named in a recording is not read" in page or "missing, since the cell is not installed" in page


@pytest.mark.parametrize("kind", ["--csv", "--images"])
def test_export_stays_in_its_folder(kind, path, capsys):
    image = packed(Image(header=Header(stamp=1), height=2, width=2, encoding="mono8", step=2, data=b"abcd"))
    more = {} if kind == "--csv" else {"payload": image, "message": "Image"}
    write(path, *(joints(number, key=f"panda/{topic}", **more) for number, topic in enumerate(TOPICS)))
    target = path.parent / "deep" / "target"
    target.mkdir(parents=True)
    assert app.execute(["export", str(path), kind, str(target)]) == 0
    assert len(list(target.iterdir())) == len(TOPICS)
    assert {each.name for each in path.parent.iterdir()} == {"run.mcap", "deep"}
    assert [each.name for each in (path.parent / "deep").iterdir()] == ["target"]
    assert not STEERING.search(capsys.readouterr().out)


def test_file_names_are_unique_and_those_of_the_topics_where_possible():
    names = {"camera/image_raw": "camera_image_raw", "tf_static": "tf_static"}
    assert file_names(list(names)) == names
    assert len(set(file_names(TOPICS).values())) == len(TOPICS)


@pytest.mark.parametrize("topic", ["**", "a/*", "a//b", "/a", "a?b", "", "../up", "a\x1b"])
def test_invalid_key_is_not_played(topic, path, rejection):
    write(path, joints(0, key=f"panda/{topic}"))
    assert "which is not a key" in rejection("play", str(path))


def test_text_of_a_recording_controls_neither_terminal_nor_page(path, capsys):
    line = LogLine.model_construct(header=Header(stamp=1), service=EVIL, level="error", message=EVIL)
    logged = joints(6, key="panda/log", payload=packed(line), message="LogLine", kind="event")
    write(path, *map(joints, range(5)), logged,
          joints(7, key=f"panda/{EVIL}", message=EVIL, schema=b"{}"), ended={"missed": {f"panda/{EVIL}": 3}},
          run={"overrides": [EVIL], "world": EVIL, EVIL: EVIL}, made=EVIL, versions={"zencell": EVIL})
    for each in ("info", "report", "export", "recover"):
        app.execute(command(each, path))
        shown = capsys.readouterr()
        assert not STEERING.search(shown.out + shown.err), each
    page = path.with_suffix(".html").read_text()
    assert not STEERING.search(page) and "<script>alert" not in page


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e308, -1e308])
def test_report_of_impossible_numbers_is_one_line_at_most(number, path, capsys):
    state = JointState.model_construct(header=Header(stamp=1), name=[f"panda_joint{k}" for k in range(1, 8)],
                                       position=[number] * 7, velocity=[number] * 7, effort=[])
    write(path, *(joints(k, payload=packed(state)) for k in range(5)), status(6))
    code = app.execute(["report", str(path)])
    lines = capsys.readouterr().err.splitlines()
    assert (code, len(lines)) in ((0, 0), (2, 1)), lines


@pytest.mark.slow
def test_damaged_byte_is_one_line(path, capsys):
    whole = run_with(path).read_bytes()
    for at in range(0, len(whole), max(1, len(whole) // 10)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1:])
        for each in ("info", "export", "recover"):
            code = app.execute(command(each, path))
            lines = capsys.readouterr().err.splitlines()
            assert code in (0, 2) and len(lines) <= (1 if code else 20), lines
