"""The dropping writer never blocks, and reports how many lines it dropped."""

import fcntl
import io
import logging
import os

import pytest

from common.process.log import DroppingWriter, log_to_stderr

SMALL = 4096
WAIT = 20.0  # [s] until a test gives up


@pytest.fixture
def pipe():
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, SMALL)
    with os.fdopen(write, "w") as stream:
        yield read, stream
    os.close(read)


def read_until(read, last):
    text = b""
    while last not in text:
        text += os.read(read, 65536)
    return text.decode()


def test_all_lines_are_written_in_order_while_they_are_read(pipe):
    read, stream = pipe
    writer = DroppingWriter(stream)
    for number in range(1000):
        writer.put(f"{number}\n")
    assert read_until(read, b"\n999\n").split() == [str(number) for number in range(1000)]
    writer.flush(WAIT)
    text = io.StringIO()
    DroppingWriter(text).put("now\n")
    assert text.getvalue() == "now\n", "a stream without a file descriptor is written directly"


def test_stalled_reader_blocks_no_writer_and_gets_the_number_of_dropped_lines_later(pipe):
    read, stream = pipe
    writer = DroppingWriter(stream, most=10_000)
    for number in range(5000):
        writer.put(f"{number:04d} {'x' * 95}\n")
    writer.flush(0.05)  # gives up
    lines = read_until(read, b"were dropped: the reader was too slow\n").splitlines()
    written = [line for line in lines if line.endswith("x")]
    assert [int(line[:4]) for line in written] == list(range(len(written))), "the first lines stay, in order"
    assert int(lines[-1].split()[0]) == 5000 - len(written) > 0
    writer.put("after\n")
    assert read_until(read, b"after\n") == "after\n"


def test_writer_ends_when_the_reader_has_closed_the_pipe():
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as stream:
        writer = DroppingWriter(stream)
        for _ in range(10):
            writer.put("x" * SMALL)
            writer.flush(WAIT)
        assert writer._thread is not None
        writer._thread.join(WAIT)
        assert not writer._thread.is_alive()


@pytest.mark.parametrize("as_json", [False, True])
def test_log_of_a_process_reports_dropped_lines_in_its_own_format(pipe, monkeypatch, as_json):
    read, stream = pipe
    monkeypatch.setattr("sys.stderr", stream)
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    try:
        log_to_stderr("camera", as_json=as_json)
        for _ in range(1500):
            root.info("x" * 1000)
        for handler in root.handlers:
            handler.flush()
        last = read_until(read, b"too slow").splitlines()[-1]
    finally:
        root.handlers[:] = before
        root.setLevel(level)
    assert last.startswith('{"time"' if as_json else "WARNING camera: ")
    assert "lines were dropped: the reader was too slow" in last
