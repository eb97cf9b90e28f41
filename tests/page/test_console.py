from __future__ import annotations

import asyncio
import threading

import pytest

from common.errors import NoResponder, ZencellError
from page.console import Desk


async def test_orders_of_any_thread_are_done_in_order_on_the_loop() -> None:
    done: list[tuple[int, int]] = []
    ended = asyncio.Event()
    desk = Desk()
    running = asyncio.create_task(desk.run())

    def order() -> None:
        for number in range(100):
            desk.put(lambda number=number: done.append((number, threading.get_ident())))
        desk.put(ended.set)

    await asyncio.to_thread(order)
    async with asyncio.timeout(30):
        await ended.wait()
    running.cancel()
    assert done == [(number, threading.get_ident()) for number in range(100)]


async def test_what_a_person_can_understand_is_told_and_the_rest_goes_on() -> None:
    told: list[str] = []
    ended = asyncio.Event()
    desk = Desk()
    desk.tell = lambda line, _kind="bad": told.append(line)
    running = asyncio.create_task(desk.run())

    def refuse() -> None:
        raise ZencellError("not now")

    async def ask() -> None:
        raise NoResponder("motion/plan")

    async def last() -> None:
        ended.set()

    for act in (refuse, ask, last):
        desk.put(act)
    async with asyncio.timeout(30):
        await ended.wait()
    running.cancel()
    assert told == ["not now", "nobody answers motion/plan now"]


async def test_long_request_holds_nothing_up() -> None:
    never, ended = asyncio.Event(), asyncio.Event()
    desk = Desk()
    running = asyncio.create_task(desk.run())

    async def wait() -> None:
        await never.wait()

    desk.put(wait)
    desk.put(ended.set)
    async with asyncio.timeout(30):
        await ended.wait()
    running.cancel()


async def test_bug_ends_the_service() -> None:
    desk = Desk()

    async def broken() -> None:
        raise KeyError("a bug")

    desk.put(broken)
    with pytest.raises(ExceptionGroup) as error:
        async with asyncio.timeout(30):
            await desk.run()
    assert error.group_contains(KeyError)
