"""Plain `log` and `counters` keys for plain Zenoh clients: each message once, and only if its signature matches."""

from __future__ import annotations

import asyncio

import pytest

from common import messages as m
from common import topics
from common.supervision.liveness_watchdog import RemoteServices
from common.supervision.plain_keys import copy_to_plain_keys
from common.transport.bus import Bus
from common.transport.codec import decode
from tests.common.transport.conftest import NewBus, until


class PlainClient:
    """A plain Zenoh client: what it receives under a plain key."""

    def __init__(self, bus: Bus, key: str, message: type[m.Message]) -> None:
        self.received: list[m.Message] = []
        self.subscriber = bus._session.subscriber(
            f"{bus.cell}/{key}", lambda sample: self.received.append(decode(message, sample.payload)))


def line(service: str, message: str) -> m.LogLine:
    return m.LogLine(service=service, level="info", message=message)


@pytest.fixture
async def start_copying():
    """Starts the task of a supervisor that copies to the plain keys."""
    tasks = []
    yield lambda bus, elsewhere: tasks.append(asyncio.create_task(copy_to_plain_keys(bus, elsewhere)))
    for task in tasks:
        task.cancel()
    for ended in await asyncio.gather(*tasks, return_exceptions=True):
        assert isinstance(ended, asyncio.CancelledError)


async def test_plain_subscriber_and_reader_receive_each_line_once(new_bus: NewBus, start_copying, caplog) -> None:
    supervisor, arm, tool = [await new_bus(name) for name in ("supervisor", "arm", "tool")]
    plain, counted = PlainClient(tool, "log", m.LogLine), PlainClient(tool, "counters", m.ServiceCounters)
    start_copying(supervisor, RemoteServices("host", ["arm"]))
    await arm.ready()
    writer, own = arm.writer(topics.LOG), supervisor.writer(topics.LOG)
    await until(lambda: writer.matched and own.matched)
    reader, raw, read = tool.reader(topics.LOG), [], []
    tool.raw_subscriber(f"{tool.cell}/**", lambda sample: raw.append(sample.key))

    async def listen() -> None:
        async for each in reader:
            read.append(each)

    def both_received() -> bool:
        writer.put(line("arm", "hello"))
        return bool(plain.received and read)

    listening = asyncio.create_task(listen())
    await until(both_received)
    lines = [line("arm", "0"), line("arm", "1"), line("supervisor", "well")]
    for each in lines:
        (own if each.service == "supervisor" else writer).put(each)
    for received in (plain.received, read):
        await until(lambda: len([each for each in received if each.message != "hello"]) >= len(lines))  # noqa: B023
        writer.put(line("arm", "hello"))
        assert sorted((each for each in received if each.message != "hello"), key=str) == sorted(lines, key=str)
    await until(lambda: counted.received)
    listening.cancel()
    assert not {f"{tool.cell}/log", f"{tool.cell}/counters"} & set(raw)
    assert "no longer reads that key" not in caplog.text


async def test_two_supervisors_copy_each_line_once_and_no_forged_one(new_bus: NewBus, start_copying) -> None:
    hosts = {host: await new_bus("supervisor") for host in ("a", "b")}
    arm, eye, tool = [await new_bus(name) for name in ("arm", "eye", "tool")]
    plain = PlainClient(tool, "log", m.LogLine)
    service_of = {"a": "arm", "b": "eye"}
    for host, bus in hosts.items():
        elsewhere = RemoteServices(host, [service_of[host]])
        for other, service in service_of.items():
            elsewhere.update(m.SupervisorStatus(cell="c", host=other, services=[
                m.ServiceStatus(name=service, host=other, state="ready")]))
        start_copying(bus, elsewhere)
    writers = {bus.service: bus.writer(topics.LOG) for bus in (arm, eye, tool, hosts["b"])}

    def all_received() -> bool:
        for service, writer in writers.items():
            writer.put(line(service, "hello"))
        return {each.service for each in plain.received} == set(writers)

    await until(all_received)
    writers["eye"].put(line("arm", "forged"))
    for service, writer in writers.items():
        writer.put(line(service, "genuine"))
    for service, writer in writers.items():
        writer.put(line(service, "last"))
    await until(lambda: sum(each.message == "last" for each in plain.received) >= len(writers))
    assert sorted((each.service, each.message) for each in plain.received if each.message != "hello") == sorted(
        (service, text) for service in writers for text in ("genuine", "last"))


async def test_nothing_is_copied_while_plain_keys_have_no_subscriber(new_bus: NewBus, start_copying) -> None:
    supervisor, arm, tool = [await new_bus(name) for name in ("supervisor", "arm", "tool")]
    writer = arm.writer(topics.LOG)
    start_copying(supervisor, RemoteServices("host", ["arm"]))
    plain = PlainClient(tool, "log", m.LogLine)
    await until(lambda: writer.matched)
    plain.subscriber.undeclare()
    await until(lambda: not writer.matched)
