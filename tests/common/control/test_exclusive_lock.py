"""Only one executor uses the state files of a cell: a second one is refused, and waits for one that is just ending."""

from __future__ import annotations

import asyncio
import fcntl
import os
from pathlib import Path

import pytest

from common.control import interlocks
from common.control.interlocks import exclusive_lock
from common.errors import ConfigError


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(interlocks, "LOCK_TIMEOUT", 0.0)
    return tmp_path / "state" / "panda.inhibits.json"


async def refusal(record: Path) -> str:
    with pytest.raises(ConfigError, match=r"^ZENCELL_STATE: .*/state") as caught:
        async with exclusive_lock(record, "another"):
            pass
    assert "\n" not in str(caught.value)
    return str(caught.value)


async def test_second_executor_of_a_cell_is_refused_in_one_line_that_names_the_first(record: Path) -> None:
    async with exclusive_lock(record, "executor of panda"):
        text = await refusal(record)
        assert "is in use by executor of panda, " in text and f"process {os.getpid()} on " in text
        async with exclusive_lock(record.with_name("ur5.inhibits.json"), "of another cell"):
            pass
    async with exclusive_lock(record, "another"):
        pass


async def test_second_executor_waits_for_one_that_is_just_ending(record: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waits, sleep = asyncio.Event(), asyncio.sleep

    async def second() -> None:
        async with exclusive_lock(record, "second"):
            pass

    async def counted(seconds: float) -> None:
        waits.set()
        await sleep(seconds)

    monkeypatch.setattr(interlocks, "LOCK_TIMEOUT", 60.0)
    async with asyncio.timeout(20):
        async with exclusive_lock(record, "first"):
            monkeypatch.setattr(interlocks.asyncio, "sleep", counted)
            waiting = asyncio.create_task(second())
            await waits.wait()
            assert not waiting.done()
        await waiting


async def test_lock_of_the_kernel_by_an_unknown_process_counts_until_that_ends(record: Path) -> None:
    record.parent.mkdir()
    with record.with_suffix(".lock").open("w") as file:  # closed by the kernel when its process is killed
        fcntl.flock(file, fcntl.LOCK_EX)
        assert "is in use by another process" in await refusal(record)
    async with exclusive_lock(record, "second"):
        pass


@pytest.mark.parametrize("kind", ["a file for a folder", "a folder for the lock", "a link for the lock"])
async def test_lock_that_cannot_be_created_is_refused_in_one_line(record: Path, kind: str) -> None:
    if kind == "a file for a folder":
        record.parent.write_text("")
    else:
        record.parent.mkdir()
        lock = record.with_suffix(".lock")
        lock.mkdir() if kind == "a folder for the lock" else lock.symlink_to(record.parent / "elsewhere")
    text = await refusal(record)
    assert "cannot be written (" in text and "): stops" in text and not (record.parent / "elsewhere").exists()
