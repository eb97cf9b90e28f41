"""Log and counters have a key per service, which no other service can use, and copies under plain keys for others."""

import asyncio

import pytest

from common import messages as m
from common import topics
from common.application import find_topic
from common.supervision.lifecycle import copy_to_plain_keys
from common.supervision.liveness_watchdog import RemoteServices
from common.transport.bus import Bus
from common.transport.codec import Attachment, decode, encode, encode_attachment
from common.transport.local import LocalNetwork
from tests.common.transport.conftest import TIMEOUT, next_of, put_raw, until


def line(service: str, message: str = "") -> m.LogLine:
    return m.LogLine(service=service, level="info", message=message)


def counted(service: str, number: int = 0) -> m.ServiceCounters:
    return m.ServiceCounters(service=service, received={"tf": number})


def put(bus: Bus, key: str, message: m.Message, writer: str = "", sequence: int = 1) -> None:
    put_raw(bus, key, encode(message), encode_attachment(Attachment(writer, sequence)) if writer else b"")


async def test_each_service_writes_under_its_name_and_one_reader_receives_all(new_bus) -> None:
    camera, arm, tool = [await new_bus(name) for name in ("camera", "arm", "tool")]
    reader, writers = tool.reader(topics.LOG), [bus.writer(topics.LOG) for bus in (camera, arm)]
    assert [writer.topic.key for writer in writers] == ["log/camera", "log/arm"]
    await until(lambda: all(writer.matched for writer in writers))
    for service, writer in zip(("camera", "arm"), writers, strict=True):
        writer.put(line(service))
    assert {(await next_of(reader)).service for _ in writers} == {"camera", "arm"}
    for bus in (camera, arm):
        await bus.ready()
    await until(lambda: all(bus._counters.raw._last for bus in (camera, arm)))
    late = (await new_bus("late")).reader(topics.COUNTERS)
    found: set[str] = set()
    async with asyncio.timeout(TIMEOUT):
        while found != {"camera", "arm"}:
            found.add((await late.next()).service)
    await tool.ready()
    async with asyncio.timeout(TIMEOUT):
        while (await late.next()).received != {"log/<service>": 2}:
            pass


@pytest.mark.parametrize(("topic", "message_of"), [(topics.LOG, line), (topics.COUNTERS, counted)])
async def test_message_in_the_name_of_another_service_is_refused(new_bus, caplog, topic, message_of) -> None:
    camera, tool = await new_bus("camera"), await new_bus("tool")
    reader = tool.reader(topic)
    plain = topic.key.partition("/")[0]
    await until(lambda: camera.writer(topic).matched)
    put(camera, f"{plain}/camera", message_of("arm"), "arm.1")
    put(camera, f"{plain}/camera/arm", message_of("arm"))
    put(camera, f"{plain}/arm", message_of("arm"), "arm.1")
    assert await next_of(reader) == message_of("arm")
    assert reader.invalid == 2 and tool.counters().invalid == {topic.key: 2}
    await until(lambda: "service: must be 'camera' under" in caplog.text)
    assert f"/{plain}/camera, not 'arm'" in caplog.text


async def test_forged_sequence_numbers_do_not_hide_messages_of_the_real_writer(new_bus) -> None:
    camera, tool = await new_bus("camera"), await new_bus("tool")
    reader = tool.reader(topics.LOG)
    await until(lambda: camera.writer(topics.LOG).matched)
    put(camera, "log/camera", line("camera"), "arm.1", 1000)  # the writer id of the real arm
    put(camera, "log/arm", line("arm"), "arm.1", 1)
    assert [(await next_of(reader)).service for _ in range(2)] == ["camera", "arm"]


async def test_flood_of_one_service_displaces_no_counters_of_another() -> None:
    net = LocalNetwork()
    reader, bus = net.bus("tool").reader(topics.COUNTERS), net.bus("camera")
    put(bus, "counters/arm", counted("arm", 7))
    for number in range(2000):
        put(bus, "counters/camera", counted("camera", number))
    assert [await next_of(reader), await next_of(reader)] == [counted("arm", 7), counted("camera", 1999)]
    assert reader.latest == counted("camera", 1999) and reader.dropped == 1999


async def test_former_plain_key_is_still_read_with_one_warning(new_bus, caplog) -> None:
    old, tool = await new_bus("old"), await new_bus("tool")
    reader = tool.reader(topics.LOG)
    await until(lambda: old.writer(topics.LOG).matched)
    for number in ("1", "2"):
        put(old, "log", line("any", number))
    assert [(await next_of(reader)).message for _ in range(2)] == ["1", "2"]
    assert caplog.text.count("a client publishes under log; the next version no longer reads that key") == 1


def test_topic_is_found_by_its_plain_key_and_by_that_of_one_service() -> None:
    assert find_topic("log") is topics.LOG is find_topic("log/<service>")
    assert find_topic("param/<service>") is topics.PARAMETERS and find_topic("camera/image_raw") is topics.CAMERA_IMAGE
    assert find_topic("counters/arm") == topics.of_service(topics.COUNTERS, "arm")
    assert find_topic("param/arm") == topics.parameters_of("arm")
    assert [find_topic(key) for key in ("param", "param/", "param/a/b", "log/a b", "log/a/b", "no")] == [None] * 6
    assert [topics.general_key(key) for key in ("log", "log/arm", "tf", "param", "param/arm")] == [
        "log/<service>", "log/<service>", "tf", "param", "param/<service>"]


# --- copies under the plain keys, for plain Zenoh clients ------------------------------------------------------------


class PlainClient:
    """A plain Zenoh client, and the messages that it receives under a plain key."""

    def __init__(self, bus: Bus, key: str, message: type[m.Message]) -> None:
        self.received: list[m.Message] = []
        self.subscriber = bus._session.subscriber(
            f"{bus.cell}/{key}", lambda sample: self.received.append(decode(message, sample.payload)))


@pytest.fixture
async def start_copying():
    """Starts the task of a supervisor that copies to the plain keys."""
    tasks = []
    yield lambda bus, elsewhere: tasks.append(asyncio.create_task(copy_to_plain_keys(bus, elsewhere)))
    for task in tasks:
        task.cancel()
    for ended in await asyncio.gather(*tasks, return_exceptions=True):
        assert isinstance(ended, asyncio.CancelledError)


async def test_plain_subscriber_and_reader_receive_each_line_once(new_bus, start_copying, caplog) -> None:
    supervisor, arm, tool = [await new_bus(name) for name in ("supervisor", "arm", "tool")]
    plain, counters = PlainClient(tool, "log", m.LogLine), PlainClient(tool, "counters", m.ServiceCounters)
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
        for service, each in (("arm", writer), ("supervisor", own)):
            each.put(line(service, "hello"))
        return all({each.service for each in received} == {"arm", "supervisor"} for received in (plain.received, read))

    listening = asyncio.create_task(listen())
    await until(both_received)
    lines = [line("arm", "0"), line("arm", "1"), line("supervisor", "well")]
    for each in lines:
        (own if each.service == "supervisor" else writer).put(each)
    for received in (plain.received, read):
        await until(lambda: len([each for each in received if each.message != "hello"]) >= len(lines))  # noqa: B023
        writer.put(line("arm", "hello"))
        assert sorted((each for each in received if each.message != "hello"), key=str) == sorted(lines, key=str)
    await until(lambda: counters.received)
    listening.cancel()
    assert not {f"{tool.cell}/log", f"{tool.cell}/counters"} & set(raw)
    assert "no longer reads that key" not in caplog.text


async def test_two_supervisors_copy_each_line_once_and_no_forged_one(new_bus, start_copying) -> None:
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
    for text in ("genuine", "last"):
        for service, writer in writers.items():
            writer.put(line(service, text))
    await until(lambda: sum(each.message == "last" for each in plain.received) >= len(writers))
    assert sorted((each.service, each.message) for each in plain.received if each.message != "hello") == sorted(
        (service, text) for service in writers for text in ("genuine", "last"))


async def test_nothing_is_copied_while_plain_keys_have_no_subscriber(new_bus, start_copying) -> None:
    supervisor, arm, tool = [await new_bus(name) for name in ("supervisor", "arm", "tool")]
    writer = arm.writer(topics.LOG)
    start_copying(supervisor, RemoteServices("host", ["arm"]))
    plain = PlainClient(tool, "log", m.LogLine)
    await until(lambda: writer.matched)
    plain.subscriber.undeclare()
    await until(lambda: not writer.matched)
