from __future__ import annotations

import asyncio
import uuid

import pytest

from common import topics
from common.errors import NoResponder, Refused, RemoteError, RequestLost, RequestTimeout
from common.messages import TaskCommand, TaskStatus
from common.topics import Request
from common.transport import requests
from common.transport.bus import Bus
from common.transport.codec import decode_error, encode
from common.transport.local import LocalNetwork
from common.transport.session import RawReply, serves_key
from common.transport.zenoh_session import connect

TIMEOUT = 20.0
START = TaskCommand(command="start")


async def answer(request: TaskCommand) -> TaskStatus:
    return TaskStatus(message=request.command)


async def query_raw(bus: Bus, key: str, payload: bytes | None) -> list[RawReply]:
    """Return the replies to a query of a plain Zenoh client."""
    replies: list[RawReply] = []
    done = asyncio.Event()
    loop = asyncio.get_running_loop()
    bus._session.get(key, replies.append, lambda: loop.call_soon_threadsafe(done.set), payload=payload)
    await asyncio.wait_for(done.wait(), TIMEOUT)
    return replies


async def served(bus: Bus, handler=answer) -> None:
    bus.serve(topics.TASK_COMMAND, handler)
    await bus.ready()


async def test_request_is_answered(new_bus) -> None:
    server, client = await new_bus("server"), await new_bus("client")
    await served(server)
    call = client.client(topics.TASK_COMMAND)
    await call.wait_available(TIMEOUT)
    assert call.available
    assert (await call.call(TaskCommand(command="pause"))).message == "pause"


async def test_service_can_call_itself(new_bus) -> None:
    bus = await new_bus()
    await served(bus)
    assert (await bus.client(topics.TASK_COMMAND).call(START)).message == "start"


async def test_call_right_after_creating_the_client_finds_the_server(new_bus) -> None:
    server, client = await new_bus("server"), await new_bus("client")
    await served(server)
    await client.alive.wait("server", TIMEOUT)
    assert (await client.client(topics.TASK_COMMAND).call(START)).message == "start"


async def test_all_servers_are_found_while_the_session_watches_one_of_them(shared_router) -> None:
    cell, names = f"test_{uuid.uuid4().hex[:8]}", [f"server_{number}" for number in range(8)]
    async with connect(cell=cell, service="host", endpoint=shared_router) as host:
        for name in names:
            host._declare_token(serves_key(cell, f"param/{name}", name))
        for _ in range(60):  # Zenoh's own query misses one of them in every tenth round
            async with connect(cell=cell, service="client", endpoint=shared_router) as client:
                await client.raw_tokens(serves_key(cell, "param/*"), TIMEOUT)
                await client._watch(serves_key(cell, f"param/{names[3]}")).known(TIMEOUT)
                for _ in range(4):
                    tokens = await client.raw_tokens(serves_key(cell, "param/*"), TIMEOUT)
                    assert [token.rpartition("/")[2] for token in tokens] == names


async def test_missing_server_is_known_before_sending(new_bus) -> None:
    bus = await new_bus()
    call = bus.client(topics.TASK_COMMAND)
    with pytest.raises(NoResponder, match="task/command"):
        await call.call(START)
    assert not call.available
    with pytest.raises(NoResponder):
        await call.wait_available(0.01)


async def test_server_that_is_not_ready_is_no_responder(new_bus) -> None:
    server, client = await new_bus("server"), await new_bus("client")
    server.serve(topics.TASK_COMMAND, answer)
    with pytest.raises(NoResponder):
        await client.client(topics.TASK_COMMAND).call(START)


async def test_refusal_reaches_the_requester_with_code_and_reason(new_bus) -> None:
    async def refuse(_: TaskCommand) -> TaskStatus:
        raise Refused("full", "the container is full")

    server, client = await new_bus("server"), await new_bus("client")
    await served(server, refuse)
    call = client.client(topics.TASK_COMMAND)
    await call.wait_available(TIMEOUT)
    with pytest.raises(RemoteError, match="the container is full") as caught:
        await call.call(START)
    assert caught.value.code == "full"


async def test_held_request_times_out_and_the_next_is_served_meanwhile(new_bus) -> None:
    async def hold_first(request: TaskCommand) -> TaskStatus:
        if request.command == "pause":
            await asyncio.Event().wait()
        return await answer(request)

    server, client = await new_bus("server"), await new_bus("client")
    await served(server, hold_first)
    call = client.client(topics.TASK_COMMAND)
    await call.wait_available(TIMEOUT)
    held = asyncio.create_task(call.call(TaskCommand(command="pause"), timeout=0.5))
    assert (await call.call(START)).message == "start"
    with pytest.raises(RequestTimeout, match=r"within 0\.5 s"):
        await held


async def test_server_that_closes_loses_the_request_in_work(new_bus) -> None:
    began = asyncio.Event()

    async def hold(_: TaskCommand) -> TaskStatus:
        began.set()
        await asyncio.Event().wait()
        raise AssertionError

    server, client = await new_bus("server"), await new_bus("client")
    await served(server, hold)
    call = client.client(topics.TASK_COMMAND)
    await call.wait_available(TIMEOUT)
    waiting = asyncio.create_task(call.call(START, timeout=TIMEOUT))
    await began.wait()
    await server.close()
    with pytest.raises(RequestLost):
        await waiting
    with pytest.raises(NoResponder):
        async with asyncio.timeout(TIMEOUT):
            while True:  # the token may vanish shortly after the query has ended
                await call.call(START, timeout=0.2)


async def test_bug_in_a_handler_is_reported_to_the_client_and_ends_the_service(new_bus) -> None:
    async def crash(_: TaskCommand) -> TaskStatus:
        raise KeyError("slot")

    async def service(bus: Bus) -> None:
        await served(bus, crash)
        await asyncio.Event().wait()

    server, client = await new_bus("server"), await new_bus("client")
    running = asyncio.create_task(server.run(service(server)))
    call = client.client(topics.TASK_COMMAND)
    await call.wait_available(TIMEOUT)
    with pytest.raises(RemoteError, match="KeyError") as caught:
        await call.call(START)
    assert caught.value.code == "internal"
    with pytest.raises(KeyError, match="slot"):
        await asyncio.wait_for(running, TIMEOUT)


async def test_failed_request_within_a_handler_is_reported_and_does_not_end_the_service(new_bus) -> None:
    server, client = await new_bus("server"), await new_bus("client")
    inner = server.client(topics.MOTION_STOP)

    async def call_inner(_: TaskCommand) -> TaskStatus:
        raise NoResponder(inner.topic.key)

    await served(server, call_inner)
    call = client.client(topics.TASK_COMMAND)
    await call.wait_available(TIMEOUT)
    with pytest.raises(RemoteError, match="motion/stop: no service") as caught:
        await call.call(START)
    assert caught.value.code == "upstream"


async def test_bad_requests_are_refused_with_the_reason_and_the_next_is_served(new_bus) -> None:
    server, client = await new_bus("server"), await new_bus("client")
    await served(server)
    call = client.client(topics.TASK_COMMAND)
    await call.wait_available(TIMEOUT)
    key = f"{server.cell}/task/command"
    cases = [
        (f"{server.cell}/**", b"", "bad_request", f"{key} is a request"),
        (f"{server.cell}/task/*", encode(START), "bad_request", f"{key} is a request"),
        (f"{key}?now=1", encode(START), "bad_request", f"{key} is a request"),
        (key, None, "bad_request", "a TaskCommand as payload is needed"),
        (key, b"\xc1", "invalid", "not msgpack"),
        (key, encode(START)[:-1], "invalid", "not msgpack"),
        (key, encode(TaskStatus()), "invalid", "TaskCommand"),
    ]
    for expression, payload, code, reason in cases:
        replies = await query_raw(client, expression, payload)
        assert [reply.sample for reply in replies] == [None], expression
        error_code, message = decode_error(replies[0].error)
        assert error_code == code
        assert reason in message
    assert server.counters().invalid == {"task/command": len(cases)}
    assert (await call.call(START)).message == "start"


async def test_plain_client_is_answered_under_the_exact_key(new_bus) -> None:
    server, client = await new_bus("server"), await new_bus("client")
    await served(server)
    await client.client(topics.TASK_COMMAND).wait_available(TIMEOUT)
    [reply] = await query_raw(client, f"{server.cell}/task/command", encode(START))
    assert reply.sample.key == f"{server.cell}/task/command"
    assert reply.sample.encoding == "application/msgpack;TaskStatus"


async def test_answer_of_another_kind_is_a_remote_error(new_bus) -> None:
    other = Request("task/command", TaskCommand, TaskCommand, "")

    async def echo(request: TaskCommand) -> TaskCommand:
        return request

    server, client = await new_bus("server"), await new_bus("client")
    server.serve(other, echo)
    await server.ready()
    call = client.client(topics.TASK_COMMAND)
    await call.wait_available(TIMEOUT)
    with pytest.raises(RemoteError, match="cannot be read") as caught:
        await call.call(START)
    assert caught.value.code == "bad_answer"


async def test_one_of_two_servers_acts(new_bus) -> None:
    acted = []

    async def act(request: TaskCommand) -> TaskStatus:
        acted.append(request)
        return TaskStatus()

    first, second, client = await new_bus("first"), await new_bus("second"), await new_bus("client")
    for server in (first, second):
        await server.ready()  # a second server would be refused; these two did not see each other
        server.serve(topics.TASK_COMMAND, act)
    await client.alive.wait("first", TIMEOUT)
    await client.alive.wait("second", TIMEOUT)
    await client.client(topics.TASK_COMMAND).call(START)
    assert len(acted) == 1


async def test_alive_names_services_that_are_ready(new_bus) -> None:
    service, tool = await new_bus("service"), await new_bus("tool")
    changes = []
    tool.alive.on_change(lambda name, there: changes.append((name, there)))
    with pytest.raises(TimeoutError):
        await tool.alive.wait("service", 0.01)
    await service.ready()
    await tool.alive.wait("service", TIMEOUT)
    assert tool.alive.names == {"service"}
    await service.close()
    await tool.alive.wait("service", TIMEOUT, there=False)
    assert "service" not in tool.alive
    assert changes == [("service", True), ("service", False)]


async def test_alive_changes_can_be_iterated(new_bus) -> None:
    service, tool = await new_bus("service"), await new_bus("tool")
    changes = tool.alive.changes()
    first = asyncio.ensure_future(anext(changes))
    await asyncio.sleep(0)
    await service.ready()
    assert await asyncio.wait_for(first, TIMEOUT) == ("service", True)
    await changes.aclose()


async def test_one_of_many_simultaneous_requests_starts_in_each_turn_of_the_loop() -> None:
    net, loop = LocalNetwork(), asyncio.get_running_loop()
    server, client = net.bus("server"), net.bus("client")
    turns: list[int] = []
    turn = 0

    def count() -> None:
        nonlocal turn
        turn += 1
        loop.call_soon(count)

    async def note(request: TaskCommand) -> TaskStatus:
        turns.append(turn)
        return await answer(request)

    await served(server, note)
    count()
    key = f"{client.cell}/{topics.TASK_COMMAND.key}"
    all_replies = await asyncio.gather(*(query_raw(client, key, encode(START)) for _ in range(50)))
    assert len(turns) == len(set(turns)) == 50, "other callbacks run between them"
    assert all(reply.sample is not None for replies in all_replies for reply in replies)


async def test_requests_beyond_the_queue_limit_are_refused(monkeypatch) -> None:
    monkeypatch.setattr(requests, "_MAX_PENDING", 10)
    net = LocalNetwork()
    server, client = net.bus("server"), net.bus("client")
    await served(server)
    key = f"{client.cell}/{topics.TASK_COMMAND.key}"
    replies = [reply for (reply,) in await asyncio.gather(*(query_raw(client, key, encode(START)) for _ in range(50)))]
    refused = [decode_error(reply.error) for reply in replies if reply.sample is None]
    assert len(replies) - len(refused) == 1 + 10 and {found[0] for found in refused if found} == {"busy"}
    assert (await client.client(topics.TASK_COMMAND).call(START)).message == "start", "later ones are answered"
