"""The folder of persistent state is removed while the executor runs: a stop is written again."""

import asyncio
import logging
import shutil

from common.control.interlocks import interlock_file
from common.messages import StopRequest
from common.topics import MOTION_STOP
from tests.services.executor_rig import executor


async def test_stop_is_written_again_after_its_folder_was_removed(caplog, monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path / "state"))
    caplog.set_level(logging.ERROR)
    async with executor() as client:
        await client.bus.client(MOTION_STOP).call(StopRequest(owner="anna"))
        file = interlock_file(client.bus.cell)
        shutil.rmtree(file.path.parent)
        async with asyncio.timeout(10):
            while file.find() is None:  # noqa: ASYNC110 - a file has no event
                await asyncio.sleep(0.05)
        assert [stop.by for stop in file.read().interlocks] == ["anna"]
        assert "was removed while it was in use" in caplog.text
