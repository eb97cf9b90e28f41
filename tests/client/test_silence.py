"""`topic echo` while no message comes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator

import pytest

from common import topics
from common.client import inspection
from common.client.subscriptions import NothingReceived
from common.transport.local import LocalNetwork


@pytest.mark.parametrize("has_writer", [True, False])
async def test_silence_is_an_error_after_a_timeout_and_says_when_no_service_publishes(
    has_writer: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inspection, "SILENCE", 0.01)
    network, seen, notes = LocalNetwork(), list[str](), list[str]()
    if has_writer:
        camera = network.bus("camera")
        camera.writer(topics.CAMERA_IMAGE)
        await camera.ready()

    async def lines() -> AsyncGenerator[str, None]:
        yield "first"
        await asyncio.Event().wait()

    key = topics.CAMERA_IMAGE.key
    with pytest.raises(NothingReceived, match=rf"/{key} within 0.05 s"):
        async for line in inspection.noting_silence(network.bus("tool"), lines(), key, 0.05, notes.append):
            seen.append(line)
    assert seen == ["first"] and notes == ([] if has_writer else [f"zencell: no service publishes {key} now"])
