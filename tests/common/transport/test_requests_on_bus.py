import asyncio
import uuid
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from common import topics
from common.errors import NoResponder, Refused, RemoteError, RequestLost, RequestTimeout
from common.messages import TaskCommand, TaskStatus
from common.topics import Request
from common.transport import requests
from common.transport.bus import Bus, Client
from common.transport.codec import decode_error, encode
from common.transport.local import LocalNetwork
from common.transport.session import RawReply, serves_key
from common.transport.zenoh_session import connect
from tests.common.transport.conftest import TIMEOUT, NewBus

START, PAUSE = TaskCommand(command="start"), TaskCommand(command="pause")
Handler = Callable[[TaskCommand], Awaitable[Any]]


async def answer(request: TaskCommand) -> TaskStatus:
    return TaskStatus(message=request.command)


async def hold(_: TaskCommand) -> TaskStatus:
    await asyncio.Event().wait()
    raise AssertionError


async def query_raw(bus: Bus, key: str, payload: bytes | None) -> list[RawReply]:
    """Return the replies to a query of a plain Zenoh client."""
    replies: list[RawReply] = []
    done = asyncio.Event()
    loop = asyncio.get_running_loop()
    bus._session.get(key, replies.append, lambda: loop.call_soon_threadsafe(done.set), payload=payload)
    await asyncio.wait_for(done.wait(), TIMEOUT)
    return replies


async def serving(
    new_bus: NewBus, handler: Handler = answer, topic: Request[Any, Any] = topics.TASK_COMMAND
) -> tuple[Bus, Bus, Client[TaskCommand, TaskStatus]]:
    """Return a server that is ready, another bus, and its client of the server."""
    server, bus = await new_bus("server"), await new_bus("client")
    server.serve(topic, handler)
    await server.ready()
    client = bus.client(topics.TASK_COMMAND)
    await client.wait_available(TIMEOUT)
    return server, bus, client


async def test_request_is_answered_under_the_exact_key_also_to_the_server_and_to_a_plain_client(new_bus) -> None:
    server, bus, client = await serving(new_bus)
    assert client.available and (await client.call(PAUSE)).message == "pause"
    assert (await server.client(topics.TASK_COMMAND).call(START)).message == "start"
    [reply] = await query_raw(bus, f"{server.cell}/task/command", encode(START))
    assert reply.sample.key == f"{server.cell}/task/command"
    assert reply.sample.encoding == "application/msgpack;TaskStatus"


async def test_call_right_after_creating_the_client_finds_the_server(new_bus) -> None:
    server, bus = await new_bus("server"), await new_bus("client")
    server.serve(topics.TASK_COMMAND, answer)
    await server.ready()
    await bus.alive.wait("server", TIMEOUT)
    assert (await bus.client(topics.TASK_COMMAND).call(START)).message == "start"


async def test_all_servers_are_found_while_the_session_watches_one_of_them(shared_router) -> None:
    cell, names = f"test_{uuid.uuid4().hex[:8]}", [f"server_{number}" for number in range(8)]
    async with connect(cell=cell, service="host", endpoint=shared_router, timeout=TIMEOUT) as host:
        for name in names:
            host._declare_token(serves_key(cell, f"param/{name}", name))
        for _ in range(20):  # Zenoh's own query misses one of them in every tenth round
            async with connect(cell=cell, service="client", endpoint=shared_router, timeout=TIMEOUT) as client:
                await client.raw_tokens(serves_key(cell, "param/*"), TIMEOUT)
                await client._watch(serves_key(cell, f"param/{names[3]}")).known(TIMEOUT)
                for _ in range(4):
                    tokens = await client.raw_tokens(serves_key(cell, "param/*"), TIMEOUT)
                    assert [token.rpartition("/")[2] for token in tokens] == names


@pytest.mark.parametrize("present", [False, True])
async def test_missing_or_unready_server_is_known_before_sending(new_bus, present: bool) -> None:
    server, bus = await new_bus("server"), await new_bus("client")
    if present:
        server.serve(topics.TASK_COMMAND, answer)
    client = bus.client(topics.TASK_COMMAND)
    with pytest.raises(NoResponder, match="task/command"):
        await client.call(START)
    assert not client.available
    with pytest.raises(NoResponder):
        await client.wait_available(0.01)


async def refuse(_: TaskCommand) -> TaskStatus:
    raise Refused("full", "the container is full")


async def call_a_missing_server(_: TaskCommand) -> TaskStatus:
    raise NoResponder("motion/stop")


async def echo(request: TaskCommand) -> TaskCommand:
    return request


@pytest.mark.parametrize(("handler", "answer_type", "code", "reason"), [
    (refuse, TaskStatus, "full", "the container is full"),
    (call_a_missing_server, TaskStatus, "upstream", "motion/stop: no service"),
    (echo, TaskCommand, "bad_answer", "cannot be read"),
])
async def test_failed_request_is_answered_with_code_and_reason(new_bus, handler, answer_type, code, reason) -> None:
    _, _, client = await serving(new_bus, handler, Request("task/command", TaskCommand, answer_type, ""))
    for _ in range(2):
        with pytest.raises(RemoteError, match=reason) as caught:
            await client.call(START)
        assert caught.value.code == code


async def test_held_request_times_out_and_the_next_is_served_meanwhile(new_bus) -> None:
    async def hold_pause(request: TaskCommand) -> TaskStatus:
        return await (hold if request == PAUSE else answer)(request)

    _, _, client = await serving(new_bus, hold_pause)
    held = asyncio.create_task(client.call(PAUSE, timeout=0.2))
    assert (await client.call(START)).message == "start"
    with pytest.raises(RequestTimeout, match=r"within 0\.2 s"):
        await held


async def test_server_that_closes_loses_the_request_in_work(new_bus) -> None:
    began = asyncio.Event()

    async def begin(request: TaskCommand) -> TaskStatus:
        began.set()
        return await hold(request)

    server, _, client = await serving(new_bus, begin)
    waiting = asyncio.create_task(client.call(START, timeout=TIMEOUT))
    await began.wait()
    await server.close()
    with pytest.raises(RequestLost):
        await waiting
    with pytest.raises(NoResponder):
        async with asyncio.timeout(TIMEOUT):
            while True:  # the token may vanish shortly after the query has ended
                await client.call(START, timeout=0.2)


async def test_bug_in_a_handler_is_reported_to_the_client_and_ends_the_service(new_bus) -> None:
    async def crash(_: TaskCommand) -> TaskStatus:
        raise KeyError("slot")

    server, _, client = await serving(new_bus, crash)
    running = asyncio.create_task(server.run(asyncio.Event().wait()))
    with pytest.raises(RemoteError, match="KeyError") as caught:
        await client.call(START)
    assert caught.value.code == "internal"
    with pytest.raises(KeyError, match="slot"):
        await asyncio.wait_for(running, TIMEOUT)


async def test_bad_requests_are_refused_with_the_reason_and_the_next_is_served(new_bus) -> None:
    server, bus, client = await serving(new_bus)
    key = f"{server.cell}/task/command"
    cases = [
        (f"{server.cell}/**", b"", "bad_request", f"{key} is a request"),
        (f"{server.cell}/task/*", encode(START), "bad_request", f"{key} is a request"),
        (key, None, "bad_request", "a TaskCommand as payload is needed"),
        (key, b"\xc1", "invalid", "not msgpack"),
        (key, encode(TaskStatus()), "invalid", "TaskCommand"),
    ]
    for expression, payload, code, reason in cases:
        [reply] = await query_raw(bus, expression, payload)
        assert reply.sample is None, expression
        error_code, message = decode_error(reply.error)
        assert error_code == code and reason in message
    assert server.counters().invalid == {"task/command": len(cases)}
    assert (await client.call(START)).message == "start"
    [reply] = await query_raw(bus, f"{key}?{'x' * 5_000_000}", encode(START))
    assert reply.sample is not None, "nothing reads the parameters of a query"


async def test_one_of_two_servers_acts(new_bus) -> None:
    acted = []

    async def act(request: TaskCommand) -> TaskStatus:
        acted.append(request)
        return TaskStatus()

    first, second, client = await new_bus("first"), await new_bus("second"), await new_bus("client")
    for server in (first, second):
        await server.ready()  # a second server would be refused; these two did not see each other
        server.serve(topics.TASK_COMMAND, act)
        await client.alive.wait(server.service, TIMEOUT)
    task = client.client(topics.TASK_COMMAND)
    await task.wait_available(TIMEOUT)  # its tokens come later than those of the ready services
    await task.call(START)
    assert len(acted) == 1


async def test_alive_names_services_that_are_ready_and_reports_changes(new_bus) -> None:
    service, tool = await new_bus("service"), await new_bus("tool")
    changes, iterated = [], tool.alive.changes()
    tool.alive.on_change(lambda name, there: changes.append((name, there)))
    first = asyncio.ensure_future(anext(iterated))
    with pytest.raises(TimeoutError):
        await tool.alive.wait("service", 0.01)
    await service.ready()
    await tool.alive.wait("service", TIMEOUT)
    assert tool.alive.names == {"service"}
    await service.close()
    await tool.alive.wait("service", TIMEOUT, there=False)
    assert "service" not in tool.alive
    assert changes == [("service", True), ("service", False)]
    assert await asyncio.wait_for(first, TIMEOUT) == ("service", True)
    await iterated.aclose()


def local_bus(net: LocalNetwork) -> NewBus:
    async def make(service: str) -> Bus:
        return net.bus(service)

    return make


async def test_one_of_many_simultaneous_requests_starts_in_each_turn_of_the_loop() -> None:
    loop = asyncio.get_running_loop()
    turns: list[int] = []
    turn = 0

    def count() -> None:
        nonlocal turn
        turn += 1
        loop.call_soon(count)

    async def note(request: TaskCommand) -> TaskStatus:
        turns.append(turn)
        return await answer(request)

    server, bus, _ = await serving(local_bus(LocalNetwork()), note)
    count()
    key = server.full_key(topics.TASK_COMMAND)
    all_replies = await asyncio.gather(*(query_raw(bus, key, encode(START)) for _ in range(50)))
    assert len(turns) == len(set(turns)) == 50, "other callbacks run between them"
    assert all(reply.sample is not None for replies in all_replies for reply in replies)


async def test_requests_beyond_the_queue_limit_are_refused(monkeypatch) -> None:
    monkeypatch.setattr(requests, "_MAX_PENDING", 10)
    server, bus, client = await serving(local_bus(LocalNetwork()))
    key = server.full_key(topics.TASK_COMMAND)
    replies = [reply for (reply,) in await asyncio.gather(*(query_raw(bus, key, encode(START)) for _ in range(50)))]
    refused = [decode_error(reply.error) for reply in replies if reply.sample is None]
    assert len(replies) - len(refused) == 1 + 10 and {found[0] for found in refused if found} == {"busy"}
    assert (await client.call(START)).message == "start", "later ones are answered"
