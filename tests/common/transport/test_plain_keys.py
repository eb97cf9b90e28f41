"""Plain `log` and `counters` are there for plain Zenoh clients: each message once, and nobody is signed for."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from common import messages as m
from common import topics
from common.supervision.liveness_watchdog import RemoteServices
from common.supervision.plain_keys import copy_to_plain_keys
from common.transport.bus import Bus
from common.transport.codec import decode

NewBus = Callable[..., Awaitable[Bus]]


class Plain:
    """A client that knows nothing of ours: what it hears under a plain key."""

    def __init__(self, bus: Bus, key: str, message: type[m.Message]) -> None:
        self.heard: list[m.Message] = []
        self.declared = bus._session.subscriber(
            f"{bus.cell}/{key}", lambda sample: self.heard.append(decode(message, sample.payload)))


def line(service: str, message: str) -> m.LogLine:
    return m.LogLine(service=service, level="info", message=message)


@pytest.fixture
async def keeping():
    """Starts what keeps the plain keys."""
    tasks = []
    yield lambda bus, elsewhere: tasks.append(asyncio.create_task(copy_to_plain_keys(bus, elsewhere)))
    for task in tasks:
        task.cancel()
    for ended in await asyncio.gather(*tasks, return_exceptions=True):
        assert isinstance(ended, asyncio.CancelledError)


async def test_plain_subscriber_hears_all_and_readers_of_ours_each_line_once(
    new_bus: NewBus, until, keeping, caplog
) -> None:
    supervisor, arm, tool = [await new_bus(name) for name in ("supervisor", "arm", "tool")]
    plain, counted = Plain(tool, "log", m.LogLine), Plain(tool, "counters", m.ServiceCounters)
    keeping(supervisor, RemoteServices("host", ["arm"]))
    await arm.ready()
    writer, own = arm.writer(topics.LOG), supervisor.writer(topics.LOG)
    await until(lambda: writer.matched and own.matched)
    reader, raw, ours = tool.reader(topics.LOG), [], []
    tool.raw_subscriber(f"{tool.cell}/**", lambda sample: raw.append(sample.key))

    async def listen() -> None:
        async for each in reader:
            ours.append(each)

    def heard_by_both() -> bool:
        writer.put(line("arm", "hello"))
        return bool(plain.heard and ours)

    listening = asyncio.create_task(listen())
    await until(heard_by_both)
    said = [line("arm", "0"), line("arm", "1"), line("supervisor", "well")]
    for each in said:
        (own if each.service == "supervisor" else writer).put(each)
    for heard in (plain.heard, ours):
        await until(lambda: len([each for each in heard if each.message != "hello"]) >= len(said))  # noqa: B023
        writer.put(line("arm", "hello"))
        assert sorted((each for each in heard if each.message != "hello"), key=str) == sorted(said, key=str)
    await until(lambda: counted.heard)
    listening.cancel()
    assert not {f"{tool.cell}/log", f"{tool.cell}/counters"} & set(raw)
    assert "nobody reads any more" not in caplog.text


async def test_who_signs_for_another_is_not_repeated_and_two_supervisors_say_it_once(
    new_bus: NewBus, until, keeping
) -> None:
    hosts = {host: await new_bus("supervisor") for host in ("a", "b")}
    arm, eye, tool = [await new_bus(name) for name in ("arm", "eye", "tool")]
    plain = Plain(tool, "log", m.LogLine)
    kept = {"a": "arm", "b": "eye"}
    for host, bus in hosts.items():
        elsewhere = RemoteServices(host, [kept[host]])
        for other, service in kept.items():
            elsewhere.update(m.SupervisorStatus(cell="c", host=other, services=[
                m.ServiceStatus(name=service, host=other, state="ready")]))
        keeping(bus, elsewhere)
    writers = {bus.service: bus.writer(topics.LOG) for bus in (arm, eye, tool, hosts["b"])}

    def heard_from_all() -> bool:
        for service, writer in writers.items():
            writer.put(line(service, "hello"))
        return {each.service for each in plain.heard} == set(writers)

    await until(heard_from_all)
    writers["eye"].put(line("arm", "forged"))
    for service, writer in writers.items():
        writer.put(line(service, "said"))
    for service, writer in writers.items():
        writer.put(line(service, "last"))
    await until(lambda: sum(each.message == "last" for each in plain.heard) >= len(writers))
    assert sorted((each.service, each.message) for each in plain.heard if each.message != "hello") == sorted(
        (service, word) for service in writers for word in ("said", "last"))


async def test_nothing_is_repeated_while_nobody_reads_there(new_bus: NewBus, until, keeping) -> None:
    supervisor, arm, tool = [await new_bus(name) for name in ("supervisor", "arm", "tool")]
    writer = arm.writer(topics.LOG)
    keeping(supervisor, RemoteServices("host", ["arm"]))
    plain = Plain(tool, "log", m.LogLine)
    await until(lambda: writer.matched)
    plain.declared.undeclare()
    await until(lambda: not writer.matched)
