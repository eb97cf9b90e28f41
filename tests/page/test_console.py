from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import pytest

from common.errors import NoResponder, ZencellError
from page.console import Action, ActionQueue


async def run(put: Callable[[ActionQueue], None], *, threaded: bool = False) -> list[str]:
    """Run the actions that `put` queues, until the last one; return the notifications."""
    lines, ended, actions = list[str](), asyncio.Event(), ActionQueue()
    actions.notify = lambda line, _kind="bad": lines.append(line)
    running = asyncio.create_task(actions.run())

    def put_all() -> None:
        put(actions)
        actions.put(ended.set)

    await asyncio.to_thread(put_all) if threaded else put_all()
    async with asyncio.timeout(30):
        await ended.wait()
        await asyncio.sleep(0)
    running.cancel()
    return lines


async def test_actions_of_any_thread_run_in_order_on_the_loop() -> None:
    done: list[tuple[int, int]] = []

    def put(actions: ActionQueue) -> None:
        for number in range(100):
            actions.put(lambda number=number: done.append((number, threading.get_ident())))

    await run(put, threaded=True)
    assert done == [(number, threading.get_ident()) for number in range(100)]


async def test_user_errors_are_shown_and_other_actions_continue() -> None:
    def reject() -> None:
        raise ZencellError("not now")

    async def request() -> None:
        raise NoResponder("motion/plan")

    def put(actions: ActionQueue) -> None:
        for action in (reject, request):
            actions.put(action)

    assert await run(put) == ["not now", "no service answers motion/plan now"]


async def test_pending_request_does_not_delay_other_actions() -> None:
    async def wait() -> None:
        await asyncio.Event().wait()

    await run(lambda actions: actions.put(wait))


async def test_bug_ends_the_service() -> None:
    actions = ActionQueue()

    async def broken() -> None:
        raise KeyError("a bug")

    action: Action = broken
    actions.put(action)
    with pytest.raises(ExceptionGroup) as error:
        async with asyncio.timeout(30):
            await actions.run()
    assert error.group_contains(KeyError)
