"""Cells whose output is not read, on a pipe or a terminal: they work, and stop on request."""

from __future__ import annotations

import asyncio
import fcntl
import os
import pty
import select
import signal
import threading
from pathlib import Path

import pytest
import yaml

from common import topics
from tests.cells.test_watchdogs import halfway, restarted
from tests.gaps import Gaps, Side
from tests.harness import ROOT, RunningCell, until

pytestmark = [pytest.mark.cell, pytest.mark.slow]

SECONDS = 15.0  # without reading
HELD_UP = 0.05  # largest share of that time in gaps caused by it; a blocked write would take all of it
CTRL_C, CTRL_Q, CTRL_S = b"\x03", b"\x11", b"\x13"


def full_pipe() -> tuple[int, int]:
    """A pipe that takes nothing more."""
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    os.set_blocking(write, False)
    while True:
        try:
            os.write(write, b"x" * 64)
        except BlockingIOError:
            break
    os.set_blocking(write, True)
    return read, write


@pytest.mark.parametrize("kind", ["full", "dead"])
@pytest.mark.parametrize("options", [(), ("--log-json",)])
async def test_cell_with_unread_output_works_and_can_be_stopped(
    tmp_path: Path, kind: str, options: tuple[str, ...]
) -> None:
    read, write = full_pipe()
    if kind == "dead":
        os.close(read)
    with RunningCell(tmp_path, "up", "panda", "--set", "world.count=2", *options, output=write) as cell:
        os.close(write)
        async with cell.listen() as bus:
            supervisor, motion = bus.reader(topics.SUPERVISOR_STATUS), bus.reader(topics.MOTION_STATUS)
            await until(motion, halfway, 120)
            cell.processes()["vision_detector"].send_signal(signal.SIGKILL)  # which the supervisor says, and mends
            await until(supervisor, lambda status: restarted("vision_detector", status), 60)
            await until(motion, halfway, 60)
        cell.process.send_signal(signal.SIGINT)
        assert await cell.ended(20) == 0
        assert not cell.processes()
    if kind == "full":
        os.close(read)


class Terminal:
    """A terminal whose output may stay unread."""

    def __init__(self) -> None:
        self._keys, self.device = pty.openpty()
        self.looks = threading.Event()
        self.looks.set()
        self._gone = False
        self._text = b""
        self._changed = threading.Condition()
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self._gone = True
        self.looks.set()
        self._reading.join()
        os.close(self._keys)

    def press(self, key: bytes) -> None:
        with self._changed:
            self._text = b""
        os.write(self._keys, key)

    def until(self, text: str, timeout: float = 60.0) -> None:
        """Return once the output since the last key press contains the text."""
        with self._changed:
            assert self._changed.wait_for(lambda: text.encode() in self._text, timeout), self._text[-2000:]

    def _read(self) -> None:
        while not self._gone:
            self.looks.wait()
            if not select.select([self._keys], [], [], 0.1)[0]:
                continue
            try:
                chunk = os.read(self._keys, 65536)
            except OSError:  # no process has it open any more
                return
            with self._changed:
                self._text += chunk
                self._changed.notify_all()


@pytest.mark.parametrize(("verb", "how"), [("up", "Ctrl-S"), ("run", "looks away")])
async def test_blocked_terminal_does_not_block_the_cell(tmp_path: Path, verb: str, how: str) -> None:
    file = tmp_path / "with_chatty.yaml"
    cell_file = yaml.safe_load((ROOT / "config" / "cells" / "panda.yaml").read_text())
    file.write_text(yaml.safe_dump({**cell_file, "services": {**cell_file["services"], "tests.cells.chatty": {}}},
                                   sort_keys=False))
    with Terminal() as terminal, RunningCell(
        tmp_path, verb, str(file), output=terminal.device, secrets={"TERM": "xterm"}
    ) as cell:
        os.close(terminal.device)
        cell.name = "panda"
        async with cell.listen() as bus:
            await until(bus.reader(topics.MOTION_STATUS), halfway, 120)
            executor = cell.processes()["trajectory_executor"].pid
            sides = read, unread = Side("read"), Side(f"unread, {how}")
            for side in sides:
                if side is unread and how == "Ctrl-S":
                    terminal.press(CTRL_S)
                elif side is unread:
                    terminal.looks.clear()
                gaps = Gaps(bus, cell.name, executor)
                await asyncio.sleep(SECONDS)
                gaps.add_to(side)
            report = "\n".join(map(str, [*sides, *read.own, *unread.own]))
            assert unread.states > 0.5 * read.states, report
            assert unread.held_up < read.held_up + HELD_UP * SECONDS, report
        if how == "Ctrl-S":
            terminal.press(CTRL_Q)
            terminal.until(" dropped: the reader was too slow")
            terminal.press(CTRL_S)
        terminal.press(CTRL_C)
        assert await cell.ended(30) == (0 if verb == "up" else 130)
        assert not cell.processes()
