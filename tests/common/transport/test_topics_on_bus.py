import asyncio
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress

import msgpack
import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import topics
from common.messages import Image, LogLine, Message
from common.process.log import BusLog
from common.topics import Topic
from common.transport.bus import Bus, Reader, Writer
from common.transport.codec import Attachment, checksum_of, encode, encode_attachment
from tests.common.transport.conftest import TIMEOUT, NewBus, next_of, put_raw, until

LINES = Topic("lines", LogLine, "event", "lines")
KEY = PICK_PLACE_STATUS.key


def image(number: int) -> Image:
    return Image(header={"stamp": number}, height=1, width=1, encoding="mono8", data=b"x")


def status(placed: int) -> PickPlaceStatus:
    return PickPlaceStatus(placed=placed)


def event(number: int) -> LogLine:
    return LogLine(service="tester", level="info", message=str(number))


def attachment(writer: str, sequence: int, checksum: int | None = None) -> bytes:
    return encode_attachment(Attachment(writer, sequence, checksum=checksum))


async def linked(new_bus: NewBus, topic: Topic, **options: int) -> tuple[Reader, Writer, Bus]:
    """Return a reader, a writer on another bus that knows of it, and the writer's bus."""
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader, writer = receiver.reader(topic, **options), sender.writer(topic)
    await until(lambda: writer.matched)
    return reader, writer, sender


async def test_stream_reader_gets_the_newest_once_and_counts_what_it_replaced(new_bus) -> None:
    reader, writer, _ = await linked(new_bus, topics.CAMERA_IMAGE)
    assert reader.latest is None
    for number in range(10):
        writer.put(image(number))
    await until(lambda: reader.received == 10)
    assert reader.latest.header.stamp == 9
    assert (await next_of(reader)) is reader.latest, "`latest` consumes nothing"
    assert (reader.dropped, reader.invalid, reader.overflow) == (9, 0, 0)
    waiting = asyncio.create_task(next_of(reader))
    writer.put(image(10))
    assert (await waiting).header.stamp == 10


async def test_each_of_two_waiting_tasks_gets_a_message(new_bus) -> None:
    reader, writer, _ = await linked(new_bus, topics.CAMERA_IMAGE)
    both = [asyncio.create_task(next_of(reader)) for _ in range(2)]
    await asyncio.sleep(0)  # both wait now
    for number in (4, 5):
        writer.put(image(number))
        done, _ = await asyncio.wait(both, timeout=TIMEOUT, return_when=asyncio.FIRST_COMPLETED)
        both = [task for task in both if task not in done]
        assert [task.result().header.stamp for task in done] == [number]


@pytest.fixture
def busy_cores() -> Iterator[None]:
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    yield
    for process in busy:
        process.kill()
        process.wait()


async def test_all_events_arrive_in_order_while_every_core_is_busy(new_bus, busy_cores) -> None:
    reader, writer, _ = await linked(new_bus, LINES, size=1500)
    for number in range(1500):
        writer.put(event(number))
    got: list[int] = []
    with suppress(TimeoutError):
        while len(got) < 1500:
            got.append(int((await next_of(reader)).message))
    assert got == list(range(1500))
    assert reader.overflow == 0 and reader.latest.message == "1499"


async def test_events_that_overflow_are_counted_and_reported(new_bus, caplog) -> None:
    reader, writer, _ = await linked(new_bus, LINES, size=10)
    for number in range(25):
        writer.put(event(number))
    await until(lambda: reader.received == 25)
    await until(lambda: "fell behind" in caplog.text)
    assert reader.overflow == 15
    assert [int((await next_of(reader)).message) for _ in range(10)] == list(range(15, 25))
    assert [r.levelno for r in caplog.records if "fell behind" in r.message] == [logging.ERROR]


async def test_state_is_queried_at_once_by_a_late_reader_and_by_plain_clients_with_wildcards(new_bus) -> None:
    sender, plain = await new_bus("sender"), await new_bus("plain")
    writer = sender.writer(PICK_PLACE_STATUS)
    assert await sender.raw_get(f"{sender.cell}/**", 2.0) == [], "a state that is not published has no value"
    writer.put(status(3))
    assert (await next_of(plain.reader(PICK_PLACE_STATUS))).placed == 3
    for pattern in (KEY, "**", "*"):
        samples = []
        async with asyncio.timeout(TIMEOUT):
            while not samples:
                samples = await plain.raw_get(f"{plain.cell}/{pattern}", 2.0)
        assert [sample.key for sample in samples] == [f"{plain.cell}/{KEY}"]
        assert samples[0].encoding == "application/msgpack;PickPlaceStatus"
        assert msgpack.unpackb(samples[0].payload)["placed"] == 3


async def test_plain_late_subscriber_sees_the_state_repeated_and_readers_do_not(new_bus) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader = receiver.reader(PICK_PLACE_STATUS)
    sender.writer(PICK_PLACE_STATUS).put(status(3))
    await next_of(reader)
    async with asyncio.timeout(TIMEOUT):
        seen = []
        async for sample in receiver.raw_reader(f"{receiver.cell}/**"):
            seen.append(sample)
            if len(seen) == 2:
                break
    assert seen[0] == seen[1]
    assert (reader.received, reader.dropped) == (1, 0)


async def test_restarted_writer_is_received_though_its_sequence_starts_again(new_bus) -> None:
    reader, first, sender = await linked(new_bus, PICK_PLACE_STATUS)
    for number in range(5):
        first.put(status(number))
    await until(lambda: reader.latest is not None and reader.latest.placed == 4)
    sender.writer(PICK_PLACE_STATUS).put(status(9))
    await until(lambda: reader.latest.placed == 9)


async def test_message_that_is_not_newer_is_dropped_unless_it_has_no_attachment(new_bus) -> None:
    reader, _, sender = await linked(new_bus, LINES)
    for sequence, number in ((5, 1), (5, 2), (4, 3), (6, 4)):
        put_raw(sender, LINES.key, encode(event(number)), attachment("w", sequence))
    for _ in range(2):
        put_raw(sender, LINES.key, encode(event(5)))
    assert [(await next_of(reader)).message for _ in range(4)] == ["1", "4", "5", "5"]
    assert reader.received == 4


BAD = [b"garbage", b"", encode(event(1))[:-3], encode(status(1)), msgpack.packb({"data": float("nan")})]


async def test_bad_payloads_are_dropped_counted_and_reported_once(new_bus, caplog) -> None:
    bus = await new_bus()
    reader, writer = bus.reader(LINES), bus.writer(LINES)
    await until(lambda: writer.matched)
    for payload in BAD:
        put_raw(bus, LINES.key, payload)
    put_raw(bus, LINES.key, encode(event(1)), b"invalid attachment")
    for sequence in (1, 2):
        put_raw(bus, LINES.key, b"garbage", attachment("other", sequence))
    writer.put(event(7))
    assert (await next_of(reader)).message == "7"
    assert reader.invalid == len(BAD) + 3
    await until(lambda: "other" in caplog.text)
    assert len([r for r in caplog.records if r.levelno == logging.WARNING]) == 2
    assert bus.counters().invalid == {"lines": len(BAD) + 3}


async def test_message_damaged_or_sent_under_another_key_is_refused_and_the_next_intact_one_accepted(new_bus) -> None:
    reader, _, sender = await linked(new_bus, PICK_PLACE_STATUS)
    intact = encode(status(3))
    checksum, elsewhere = (checksum_of(f"{sender.cell}/{key}", intact) for key in (KEY, "other_status"))
    for damaged in (intact[:-1], encode(status(4)), b"x" + intact[1:]):
        put_raw(sender, KEY, damaged, attachment("other", 9, checksum))
    put_raw(sender, KEY, intact, attachment("other", 9, elsewhere))
    await until(lambda: reader.invalid == 4)
    assert reader.latest is None
    put_raw(sender, KEY, intact, attachment("other", 5, checksum))
    assert (await next_of(reader)).placed == 3
    assert reader.invalid == 4


async def test_invalid_payload_does_not_displace_an_unread_state(new_bus) -> None:
    reader, writer, sender = await linked(new_bus, PICK_PLACE_STATUS)
    writer.put(status(3))
    put_raw(sender, KEY, b"garbage")
    put_raw(sender, KEY, b"garbage", attachment("other", 1))
    await until(lambda: reader.received == 3)
    assert (await next_of(reader)).placed == 3


async def test_put_of_another_message_class_raises(new_bus) -> None:
    bus = await new_bus()
    with pytest.raises(TypeError, match="carries Image, not LogLine"):
        bus.writer(topics.CAMERA_IMAGE).put(event(1))


async def test_trace_passes_from_the_read_message_to_the_published_one(new_bus) -> None:
    sender, middle, end = await new_bus("sender"), await new_bus("middle"), await new_bus("end")
    images, log = sender.writer(topics.CAMERA_IMAGE), middle.writer(LINES)
    reader, traces = middle.reader(topics.CAMERA_IMAGE), {}
    await until(lambda: images.matched)  # by this reader
    end.raw_subscriber(f"{end.cell}/**", lambda sample: traces.update(
        {sample.key.rpartition("/")[2]: msgpack.unpackb(sample.attachment)[3]}))

    async def forward() -> None:
        log.put(event((await reader.next()).header.stamp))

    forwarding = asyncio.create_task(forward())
    await until(lambda: log.matched)
    images.put(image(1))
    await until(lambda: len(traces) == 2)
    assert traces["lines"] == traces["image_raw"] != ""
    await forwarding


async def test_log_lines_are_put_on_the_log_topic(new_bus) -> None:
    service, tool = await new_bus("talker"), await new_bus("tool")
    reader, handler = tool.reader(topics.LOG), BusLog(service)
    await until(lambda: handler._writer.matched)
    service.log.addHandler(handler)
    service.log.setLevel(logging.INFO)
    try:
        service.log.debug("hidden")
        service.log.info("logged on the loop")
        await asyncio.to_thread(service.log.warning, "logged in a thread")
    finally:
        service.log.removeHandler(handler)
    lines: list[Message] = [await next_of(reader), await next_of(reader)]
    assert [(line.service, line.level, line.message) for line in lines] == [
        ("talker", "info", "logged on the loop"), ("talker", "warning", "logged in a thread")]


async def test_reader_subscribes_only_while_it_listens_and_then_gets_the_last_state(new_bus) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader, writer = receiver.reader(topics.CAMERA_IMAGE, listening=False), sender.writer(topics.CAMERA_IMAGE)
    assert not writer.matched
    for listening in (True, False, True):
        receiver.listen(reader, listening)
        await until(lambda: writer.matched is listening)  # noqa: B023
    writer.put(image(7))
    assert (await next_of(reader)).header.stamp == 7
    state = receiver.reader(PICK_PLACE_STATUS, listening=False)
    sender.writer(PICK_PLACE_STATUS).put(status(4))
    receiver.listen(state, True)
    assert (await next_of(state)).placed == 4
