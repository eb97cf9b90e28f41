"""Log and counters of a service have a key of its own; no other service can publish in its name."""

from __future__ import annotations

import pytest

from common import messages as m
from common import topics
from common.application import find_topic
from common.transport.bus import Bus
from common.transport.codec import Attachment, encode, encode_attachment
from common.transport.local import LocalNetwork
from tests.common.transport.conftest import NewBus, next_of, put_raw, until


def line(service: str, message: str = "") -> m.LogLine:
    return m.LogLine(service=service, level="info", message=message)


def counted(service: str, number: int = 0) -> m.ServiceCounters:
    return m.ServiceCounters(service=service, received={"tf": number})


def put(bus: Bus, key: str, message: m.Message, writer: str = "", sequence: int = 1) -> None:
    put_raw(bus, key, encode(message), encode_attachment(Attachment(writer, sequence)) if writer else b"")


async def test_each_service_writes_under_its_name_and_one_reader_receives_all(new_bus: NewBus) -> None:
    camera, arm, tool = await new_bus("camera"), await new_bus("arm"), await new_bus("tool")
    reader, writers = tool.reader(topics.LOG), [bus.writer(topics.LOG) for bus in (camera, arm)]
    assert [writer.topic.key for writer in writers] == ["log/camera", "log/arm"]
    await until(lambda: all(writer.matched for writer in writers))
    for service, writer in zip(("camera", "arm"), writers, strict=True):
        writer.put(line(service))
    assert {(await next_of(reader)).service for _ in writers} == {"camera", "arm"}


@pytest.mark.parametrize(("topic", "message_of"), [(topics.LOG, line), (topics.COUNTERS, counted)])
async def test_message_in_the_name_of_another_service_is_refused_and_counted(
    new_bus: NewBus, caplog, topic, message_of
) -> None:
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


async def test_forged_sequence_numbers_do_not_hide_messages_of_the_real_writer(new_bus: NewBus) -> None:
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
    for number in range(5000):
        put(bus, "counters/camera", counted("camera", number))
    assert [await next_of(reader), await next_of(reader)] == [counted("arm", 7), counted("camera", 4999)]
    assert reader.latest == counted("camera", 4999) and reader.dropped == 4999


async def test_late_reader_gets_the_counters_of_all_at_once(new_bus: NewBus) -> None:
    services = [await new_bus(name) for name in ("camera", "arm")]
    for bus in services:
        await bus.ready()
    await until(lambda: all(bus._counters.raw._last for bus in services))
    reader = (await new_bus("tool")).reader(topics.COUNTERS)
    assert {(await next_of(reader)).service for _ in services} == {"camera", "arm"}


async def test_former_plain_key_is_still_read_with_one_warning(new_bus: NewBus, caplog) -> None:
    old, tool = await new_bus("old"), await new_bus("tool")
    reader = tool.reader(topics.LOG)
    await until(lambda: old.writer(topics.LOG).matched)
    for number in ("1", "2"):
        put(old, "log", line("any", number))
    assert [(await next_of(reader)).message for _ in range(2)] == ["1", "2"]
    assert caplog.text.count("a client publishes under log; the next version no longer reads that key") == 1


def test_topic_is_found_by_its_plain_key_and_by_that_of_one_service() -> None:
    assert find_topic("log") is topics.LOG is find_topic("log/<service>")
    assert find_topic("counters/arm") == topics.of_service(topics.COUNTERS, "arm")
    assert find_topic("param/arm") == topics.parameters_of("arm") and find_topic("param") is None
    assert find_topic("log/a b") is None is find_topic("log/a/b")
    assert [topics.general_key(key) for key in ("log", "log/arm", "tf", "param", "param/arm")] == [
        "log/<service>", "log/<service>", "tf", "param", "param/<service>"]
