from __future__ import annotations

import asyncio
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress

import msgpack
import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS, REJECTED_TARGETS, PickPlaceStatus
from common import topics
from common.messages import Image, LogLine, Rejections, TFMessage
from common.process.log import BusLog
from common.transport.bus import Bus, Reader, Writer
from common.transport.codec import Attachment, checksum_of, encode, encode_attachment

TIMEOUT = 20.0
LINES = topics.Topic("lines", LogLine, "event", "lines")


def image(number: int) -> Image:
    return Image(header={"stamp": number}, height=1, width=1, encoding="mono8", data=b"x")


def status(placed: int) -> PickPlaceStatus:
    return PickPlaceStatus(placed=placed)


def event(number: int) -> LogLine:
    return LogLine(service="tester", level="info", message=str(number))


async def matched(writer: Writer, until) -> None:
    await until(lambda: writer.matched)


async def next_of(reader: Reader):
    return await asyncio.wait_for(reader.next(), TIMEOUT)


def put_raw(bus: Bus, topic, payload: bytes, attachment: bytes = b"") -> None:
    bus._session.publisher(f"{bus.cell}/{topic.key}", "", reliable=True).put(payload, attachment)


async def test_stream_reader_gets_the_newest_and_counts_what_it_replaced(new_bus, until) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader = receiver.reader(topics.CAMERA_IMAGE)
    writer = sender.writer(topics.CAMERA_IMAGE)
    await matched(writer, until)
    for number in range(10):
        writer.put(image(number))
    await until(lambda: reader.received == 10)
    assert (await next_of(reader)).header.stamp == 9
    assert reader.dropped == 9
    assert (reader.invalid, reader.overflow) == (0, 0)


async def test_latest_does_not_consume(new_bus, until) -> None:
    bus = await new_bus()
    reader, writer = bus.reader(topics.CAMERA_IMAGE), bus.writer(topics.CAMERA_IMAGE)
    assert reader.latest is None
    await matched(writer, until)
    writer.put(image(1))
    await until(lambda: reader.latest is not None)
    assert (await next_of(reader)) is reader.latest
    assert reader.dropped == 0


async def test_loop_is_woken_for_a_waiting_reader_only(new_bus, until) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader, writer = receiver.reader(topics.CAMERA_IMAGE), sender.writer(topics.CAMERA_IMAGE)
    await matched(writer, until)
    wakeups, notify = [], reader._notifier.notify

    def counting() -> None:
        wakeups.append(1)
        notify()

    reader._notifier.notify = counting  # type: ignore[method-assign]
    for number in (1, 2, 3):
        writer.put(image(number))
    await until(lambda: reader.received == 3)
    assert not wakeups and reader.latest is not None and reader.latest.header.stamp == 3
    assert (await next_of(reader)).header.stamp == 3
    both = [asyncio.create_task(next_of(reader)) for _ in range(2)]
    await asyncio.sleep(0)  # both wait now
    for number in (4, 5):
        writer.put(image(number))
        done, _ = await asyncio.wait(both, timeout=TIMEOUT, return_when=asyncio.FIRST_COMPLETED)
        both = [task for task in both if task not in done]
        assert [task.result().header.stamp for task in done] == [number]
    assert not both and wakeups


async def test_stream_message_is_returned_once(new_bus, until) -> None:
    bus = await new_bus()
    reader, writer = bus.reader(topics.CAMERA_IMAGE), bus.writer(topics.CAMERA_IMAGE)
    await matched(writer, until)
    writer.put(image(1))
    await next_of(reader)
    waiting = asyncio.create_task(reader.next())
    writer.put(image(2))
    assert (await asyncio.wait_for(waiting, TIMEOUT)).header.stamp == 2


async def test_all_events_arrive_in_order(new_bus, until) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader, writer = receiver.reader(LINES), sender.writer(LINES)
    await matched(writer, until)
    for number in range(500):
        writer.put(event(number))
    got = [int((await next_of(reader)).message) for _ in range(500)]
    assert got == list(range(500))
    assert reader.overflow == 0
    assert reader.latest.message == "499"


@pytest.fixture
def busy_cores() -> Iterator[None]:
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    yield
    for process in busy:
        process.kill()
        process.wait()


async def test_no_event_is_lost_while_every_core_is_busy(new_bus, until, busy_cores) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader, writer = receiver.reader(LINES, size=1500), sender.writer(LINES)
    await matched(writer, until)
    for number in range(1500):
        writer.put(event(number))
    got: list[int] = []
    with suppress(TimeoutError):
        while len(got) < 1500:
            got.append(int((await next_of(reader)).message))
    assert got == list(range(1500))


async def test_events_that_overflow_are_counted_and_reported(new_bus, until, caplog) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader, writer = receiver.reader(LINES, size=10), sender.writer(LINES)
    await matched(writer, until)
    for number in range(25):
        writer.put(event(number))
    await until(lambda: reader.received == 25)
    await until(lambda: "fell behind" in caplog.text)
    assert reader.overflow == 15
    assert [int((await next_of(reader)).message) for _ in range(10)] == list(range(15, 25))
    assert [r.levelno for r in caplog.records if "fell behind" in r.message] == [logging.ERROR]


async def test_late_reader_gets_the_state_at_once(new_bus) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    sender.writer(PICK_PLACE_STATUS).put(status(3))
    assert (await next_of(receiver.reader(PICK_PLACE_STATUS))).placed == 3


@pytest.mark.parametrize("pattern", ["pick_place_status", "**", "*"])
async def test_state_can_be_queried_also_with_wildcards(new_bus, pattern: str) -> None:
    sender, plain = await new_bus("sender"), await new_bus("plain")
    sender.writer(PICK_PLACE_STATUS).put(status(3))
    samples = []
    async with asyncio.timeout(TIMEOUT):
        while not samples:
            samples = await plain.raw_get(f"{plain.cell}/{pattern}", 2.0)
    assert [sample.key for sample in samples] == [f"{plain.cell}/pick_place_status"]
    assert samples[0].encoding == "application/msgpack;PickPlaceStatus"
    assert msgpack.unpackb(samples[0].payload)["placed"] == 3


async def test_unpublished_state_has_no_value(new_bus) -> None:
    bus = await new_bus()
    bus.writer(PICK_PLACE_STATUS)
    assert await bus.raw_get(f"{bus.cell}/**", 2.0) == []


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
    assert reader.received == 1
    assert reader.dropped == 0


async def test_restarted_writer_is_received_though_its_sequence_starts_again(new_bus, until) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader = receiver.reader(PICK_PLACE_STATUS)
    first = sender.writer(PICK_PLACE_STATUS)
    for number in range(5):
        first.put(status(number))
    await until(lambda: reader.latest is not None and reader.latest.placed == 4)
    sender.writer(PICK_PLACE_STATUS).put(status(9))
    await until(lambda: reader.latest.placed == 9)


async def test_message_that_is_not_newer_is_dropped(new_bus, until) -> None:
    bus = await new_bus()
    reader = bus.reader(LINES)
    await matched(bus.writer(LINES), until)
    for sequence, number in ((5, 1), (5, 2), (4, 3), (6, 4)):
        put_raw(bus, LINES, encode(event(number)), encode_attachment(Attachment("w", sequence)))
    assert (await next_of(reader)).message == "1"
    assert (await next_of(reader)).message == "4"
    assert reader.received == 2


async def test_plain_put_without_attachment_is_accepted_every_time(new_bus, until) -> None:
    bus = await new_bus()
    reader = bus.reader(LINES)
    await matched(bus.writer(LINES), until)
    put_raw(bus, LINES, encode(event(1)))
    put_raw(bus, LINES, encode(event(1)))
    assert (await next_of(reader)) == (await next_of(reader)) == event(1)


BAD = [b"garbage", b"", encode(event(1))[:-3], encode(status(1)), msgpack.packb({"data": float("nan")})]


async def test_bad_payloads_are_dropped_counted_and_reported_once(new_bus, until, caplog) -> None:
    bus = await new_bus()
    reader, writer = bus.reader(LINES), bus.writer(LINES)
    await matched(writer, until)
    for payload in BAD:
        put_raw(bus, LINES, payload)
    put_raw(bus, LINES, encode(event(1)), b"invalid attachment")
    for sequence in (1, 2):
        put_raw(bus, LINES, b"garbage", encode_attachment(Attachment("other", sequence)))
    writer.put(event(7))
    assert (await next_of(reader)).message == "7"
    assert reader.invalid == len(BAD) + 3
    await until(lambda: "other" in caplog.text)
    assert len([r for r in caplog.records if r.levelno == logging.WARNING]) == 2
    assert bus.counters().invalid == {"lines": len(BAD) + 3}


async def test_damaged_message_is_refused_and_the_next_intact_one_is_accepted(new_bus, until) -> None:
    bus = await new_bus()
    reader, writer = bus.reader(PICK_PLACE_STATUS), bus.writer(PICK_PLACE_STATUS)
    await matched(writer, until)
    sent, key = encode(status(3)), f"{bus.cell}/{PICK_PLACE_STATUS.key}"
    for damaged in (sent[:-1], encode(status(4)), b"x" + sent[1:]):
        put_raw(bus, PICK_PLACE_STATUS, damaged,
                encode_attachment(Attachment("other", 9, checksum=checksum_of(key, sent))))
    await until(lambda: reader.invalid == 3)
    put_raw(bus, PICK_PLACE_STATUS, sent,
            encode_attachment(Attachment("other", 5, checksum=checksum_of(key, sent))))
    assert (await next_of(reader)).placed == 3
    assert reader.invalid == 3


async def test_message_sent_under_another_key_is_refused(new_bus, until) -> None:
    bus = await new_bus()
    reader, writer = bus.reader(topics.TF_STATIC), bus.writer(topics.TF_STATIC)
    await matched(writer, until)
    sent = encode(TFMessage(transforms=[]))
    put_raw(bus, topics.TF_STATIC, sent,
            encode_attachment(Attachment("other", 1, checksum=checksum_of(f"{bus.cell}/{topics.TF.key}", sent))))
    await until(lambda: reader.invalid == 1)
    assert reader.latest is None


async def test_invalid_payload_does_not_displace_an_unread_state(new_bus, until) -> None:
    bus = await new_bus()
    reader, writer = bus.reader(PICK_PLACE_STATUS), bus.writer(PICK_PLACE_STATUS)
    await matched(writer, until)
    writer.put(status(3))
    put_raw(bus, PICK_PLACE_STATUS, b"garbage")
    put_raw(bus, PICK_PLACE_STATUS, b"garbage", encode_attachment(Attachment("other", 1)))
    await until(lambda: reader.received == 3)
    assert (await next_of(reader)).placed == 3


async def test_put_of_another_message_class_raises(new_bus) -> None:
    bus = await new_bus()
    with pytest.raises(TypeError, match="carries Image, not LogLine"):
        bus.writer(topics.CAMERA_IMAGE).put(event(1))


async def test_trace_passes_from_the_read_message_to_the_published_one(new_bus, until) -> None:
    sender, middle, end = await new_bus("sender"), await new_bus("middle"), await new_bus("end")
    images, log = sender.writer(topics.CAMERA_IMAGE), middle.writer(LINES)
    reader = middle.reader(topics.CAMERA_IMAGE)
    seen = {}

    async def watch() -> None:
        async for sample in end.raw_reader(f"{end.cell}/**"):
            seen[sample.key.rpartition("/")[2]] = msgpack.unpackb(sample.attachment)[3]

    async def forward() -> None:
        log.put(event((await reader.next()).header.stamp))

    watching = asyncio.create_task(watch())
    forwarding = asyncio.create_task(forward())
    await matched(images, until)
    await matched(log, until)
    images.put(image(1))
    await until(lambda: len(seen) == 2)
    assert seen["lines"] == seen["image_raw"] != ""
    watching.cancel()
    await forwarding


async def test_counters_are_published_while_they_have_a_reader(new_bus, until) -> None:
    service, tool = await new_bus("service"), await new_bus("tool")
    reader, writer = service.reader(REJECTED_TARGETS), service.writer(REJECTED_TARGETS)
    await matched(writer, until)
    writer.put(Rejections(header={}, rejected=[]))
    await next_of(reader)
    await service.ready()
    counters = tool.reader(topics.COUNTERS)
    counted = await next_of(counters)
    assert counted.service == "service"
    assert counted.received == {"rejected_targets": 1}


async def test_log_lines_are_put_on_the_log_topic(new_bus, until) -> None:
    service, tool = await new_bus("talker"), await new_bus("tool")
    reader = tool.reader(topics.LOG)
    handler = BusLog(service)
    await matched(handler._writer, until)
    service.log.addHandler(handler)
    service.log.setLevel(logging.INFO)
    try:
        service.log.debug("hidden")
        service.log.info("logged on the loop")
        await asyncio.to_thread(service.log.warning, "logged in a thread")
    finally:
        service.log.removeHandler(handler)
    lines = [await next_of(reader), await next_of(reader)]
    assert [(line.service, line.level, line.message) for line in lines] == [
        ("talker", "info", "logged on the loop"), ("talker", "warning", "logged in a thread")
    ]


async def test_header_has_cell_time(new_bus) -> None:
    bus = await new_bus()
    before = bus.clock.now_ns()
    assert before <= bus.header("world").stamp <= bus.clock.now_ns()
    assert bus.header("world").frame_id == "world"


async def test_reader_subscribes_only_while_it_listens(new_bus, until) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader, writer = receiver.reader(topics.CAMERA_IMAGE, listening=False), sender.writer(topics.CAMERA_IMAGE)
    assert not writer.matched
    receiver.listen(reader, True)
    await matched(writer, until)
    receiver.listen(reader, False)
    await until(lambda: not writer.matched)
    receiver.listen(reader, True)
    await matched(writer, until)
    writer.put(image(7))
    assert (await next_of(reader)).header.stamp == 7


async def test_state_reader_that_starts_to_listen_gets_the_last_value(new_bus, until) -> None:
    sender, receiver = await new_bus("sender"), await new_bus("receiver")
    reader = receiver.reader(PICK_PLACE_STATUS, listening=False)
    sender.writer(PICK_PLACE_STATUS).put(status(4))
    receiver.listen(reader, True)
    assert (await next_of(reader)).placed == 4
