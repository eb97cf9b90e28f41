from __future__ import annotations

import asyncio
import threading

import pytest

from common.errors import NoResponder, ZencellError
from page.console import ActionQueue


async def test_orders_of_any_thread_are_done_in_order_on_the_loop() -> None:
    done: list[tuple[int, int]] = []
    ended = asyncio.Event()
    actions = ActionQueue()
    running = asyncio.create_task(actions.run())

    def order() -> None:
        for number in range(100):
            actions.put(lambda number=number: done.append((number, threading.get_ident())))
        actions.put(ended.set)

    await asyncio.to_thread(order)
    async with asyncio.timeout(30):
        await ended.wait()
    running.cancel()
    assert done == [(number, threading.get_ident()) for number in range(100)]


async def test_what_a_person_can_understand_is_told_and_the_rest_goes_on() -> None:
    told: list[str] = []
    ended = asyncio.Event()
    actions = ActionQueue()
    actions.tell = lambda line, _kind="bad": told.append(line)
    running = asyncio.create_task(actions.run())

    def refuse() -> None:
        raise ZencellError("not now")

    async def ask() -> None:
        raise NoResponder("motion/plan")

    async def last() -> None:
        ended.set()

    for act in (refuse, ask, last):
        actions.put(act)
    async with asyncio.timeout(30):
        await ended.wait()
    running.cancel()
    assert told == ["not now", "nobody answers motion/plan now"]


async def test_long_request_holds_nothing_up() -> None:
    never, ended = asyncio.Event(), asyncio.Event()
    actions = ActionQueue()
    running = asyncio.create_task(actions.run())

    async def wait() -> None:
        await never.wait()

    actions.put(wait)
    actions.put(ended.set)
    async with asyncio.timeout(30):
        await ended.wait()
    running.cancel()


async def test_bug_ends_the_service() -> None:
    actions = ActionQueue()

    async def broken() -> None:
        raise KeyError("a bug")

    actions.put(broken)
    with pytest.raises(ExceptionGroup) as error:
        async with asyncio.timeout(30):
            await actions.run()
    assert error.group_contains(KeyError)
