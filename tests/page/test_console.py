"""The queue of actions that pages request."""

import asyncio
import threading
from unittest.mock import AsyncMock, Mock

import pytest

from common import topics
from common.config import Members
from common.errors import NoResponder, RemoteError, ZencellError
from common.messages import Header
from page.access import CURRENT_SESSION, PageSession, Permissions
from page.console import EXECUTOR, Action, ActionQueue, Console


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


@pytest.mark.parametrize(("roles", "denied"), [
    ({"look"}, {"call", "start", "own", "jog", "set", "speed"}),
    ({"look", "tune"}, {"call", "start", "own", "jog", "speed"}),
    ({"look", "operate"}, {"set"}), ({"look", "operate", "tune"}, set()), (None, set())])
async def test_roles_are_checked_again_where_a_request_leaves_the_page(
    roles: set[str] | None, denied: set[str]
) -> None:
    console = Console(Mock(), Members(services=[EXECUTOR], task="task"), Mock(), [], Permissions())
    console.permissions.enforced = True
    answer = AsyncMock(side_effect=NoResponder("sent"))
    console._clients = dict.fromkeys(console._clients, Mock(call=answer))
    console._parameters = {EXECUTOR: Mock(call=answer)}
    console.latest = lambda _topic: None  # type: ignore[method-assign]
    console._jog_writer.put = Mock(side_effect=NoResponder("sent"))  # type: ignore[method-assign]
    console._bus.header.return_value = Header(stamp=1)  # type: ignore[attr-defined]
    tries = {"call": lambda: console.call(topics.GRIPPER_COMMAND, Mock()), "start": lambda: console.command("start"),
             "stop": lambda: console.command("stop"), "own": lambda: console.own("take"),
             "jog": lambda: asyncio.to_thread(console.jog, 0, joints={"a": 0.1}),
             "speed": lambda: console.set_speed(0.5),
             "set": lambda: console.set_parameter([EXECUTOR], "services.x", 1)}
    token = CURRENT_SESSION.set(None if roles is None else PageSession(1, "10.0.0.1", frozenset(roles)))
    try:
        found = set()
        for name, attempt in tries.items():
            try:
                await attempt()
            except RemoteError as error:
                assert "no token for the role" in str(error)
                found.add(name)
            except NoResponder:
                pass
        assert found == denied
    finally:
        CURRENT_SESSION.reset(token)
