"""The queue of actions that pages request."""

import asyncio
import threading

import pytest

from common.errors import NoResponder, ZencellError
from page.console import Action, ActionQueue


async def run(*queued: Action) -> list[str]:
    """Run actions that another thread queues; return the notifications at the end of the last one."""
    lines, ended, actions = list[str](), asyncio.Event(), ActionQueue()
    actions.notify = lambda line, _kind="bad": lines.append(line)

    def put() -> None:
        for action in (*queued, ended.set):
            actions.put(action)

    running = asyncio.create_task(actions.run())
    await asyncio.to_thread(put)
    async with asyncio.timeout(30):
        await ended.wait()
        await asyncio.sleep(0)
    running.cancel()
    return lines


async def test_actions_of_any_thread_run_in_order_on_the_loop() -> None:
    done: list[tuple[int, int]] = []
    await run(*(lambda number=number: done.append((number, threading.get_ident())) for number in range(100)))
    assert done == [(number, threading.get_ident()) for number in range(100)]


async def test_errors_are_shown_and_neither_they_nor_pending_requests_delay_other_actions() -> None:
    def reject() -> None:
        raise ZencellError("not now")

    async def request() -> None:
        raise NoResponder("motion/plan")

    async def wait() -> None:
        await asyncio.Event().wait()

    assert await run(wait, reject, request) == ["not now", "the motion planner does not respond"]


async def test_bug_ends_the_service() -> None:
    actions = ActionQueue()

    async def broken() -> None:
        raise KeyError("a bug")

    actions.put(broken)
    with pytest.raises(ExceptionGroup) as error:
        async with asyncio.timeout(30):
            await actions.run()
    assert error.group_contains(KeyError)
