"""Writing never waits, and what was lost is told."""

import fcntl
import io
import logging
import os
import time

import pytest

from common.process.dropping_writer import DroppingWriter
from common.process.log import log_to_stderr

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


def test_lines_come_in_order_and_all_of_them_when_somebody_reads(pipe):
    read, stream = pipe
    writer = DroppingWriter(stream)
    for number in range(1000):
        writer.put(f"{number}\n")
    assert read_until(read, b"\n999\n").split() == [str(number) for number in range(1000)]
    writer.flush(WAIT)


def test_nobody_waits_when_nobody_reads_and_what_was_lost_is_told_when_somebody_does(pipe):
    read, stream = pipe
    writer = DroppingWriter(stream, most=10_000)
    began = time.process_time()
    for number in range(5000):
        writer.put(f"{number:04d} {'x' * 95}\n")
    assert time.process_time() - began < 2.0
    writer.flush(0.05)  # gives up
    lines = read_until(read, b"were lost: nobody read them\n").splitlines()
    kept = [line for line in lines if line.endswith("x")]
    assert [int(line[:4]) for line in kept] == list(range(len(kept))), "what was first stays, in order"
    assert int(lines[-1].split()[0]) == 5000 - len(kept) > 0
    writer.put("after\n")
    assert read_until(read, b"after\n") == "after\n"


def test_pipe_that_is_dead_is_written_to_no_more():
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


def test_text_in_memory_has_its_lines_at_once():
    text = io.StringIO()
    DroppingWriter(text).put("now\n")
    assert text.getvalue() == "now\n"


@pytest.mark.parametrize("as_json", [False, True])
def test_log_of_a_process_does_not_wait_and_tells_what_was_lost_in_its_own_format(pipe, monkeypatch, as_json):
    read, stream = pipe
    monkeypatch.setattr("sys.stderr", stream)
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    try:
        log_to_stderr("camera", as_json=as_json)
        for _ in range(15_000):
            root.info("x" * 100)
        for handler in root.handlers:
            handler.flush()
        text = read_until(read, b"nobody read them")
    finally:
        root.handlers[:] = before
        root.setLevel(level)
    last = text.splitlines()[-1]
    assert last.startswith('{"time"' if as_json else "WARNING camera: ") and "lines were lost: nobody read them" in last
