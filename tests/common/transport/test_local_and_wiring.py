import asyncio
from dataclasses import dataclass, replace

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import topics
from common.errors import NoResponder
from common.messages import Image, LogLine, TaskCommand, TaskStatus
from common.process.in_process import running_service
from common.supervision.wiring import wiring
from common.topics import Request, Topic
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from tests.common.transport.conftest import TIMEOUT, next_of

STOP = TaskCommand(command="stop")


@dataclass
class Config:
    fail: bool = False


async def service(bus: Bus, config: Config) -> None:
    images = bus.reader(topics.CAMERA_IMAGE)
    status = bus.writer(PICK_PLACE_STATUS)
    bus.client(topics.MOTION_PLAN)

    async def crash(_: TaskCommand) -> TaskStatus:
        raise RuntimeError("the handler has a bug")

    bus.serve(topics.TASK_COMMAND, crash)
    if config.fail:
        raise RuntimeError("the start has a bug")
    await bus.ready()
    async for image in images:
        bus.log.info("saw %d", image.header.stamp)
        status.put(PickPlaceStatus(placed=image.header.stamp))


async def short(bus: Bus, config: Config) -> None:
    bus.log.debug("nothing to do")


async def test_service_runs_in_process_from_its_ready_to_the_end_of_the_block() -> None:
    net = LocalNetwork()
    tester = net.bus("tester")
    status, log = tester.reader(PICK_PLACE_STATUS), tester.reader(topics.LOG)
    async with running_service(net, service, Config(), name="toy"):
        assert await tester.alive.known() == {"toy"}
        image = Image(header={"stamp": 4}, height=1, width=1, encoding="mono8", data=b"x")
        tester.writer(topics.CAMERA_IMAGE).put(image)
        assert (await next_of(status)).placed == 4
        line = await next_of(log)
        assert line == LogLine(header=line.header, service="toy", level="info", message="saw 4")
    await tester.alive.wait("toy", TIMEOUT, there=False)
    with pytest.raises(NoResponder):
        await tester.client(topics.TASK_COMMAND).call(STOP)


@pytest.mark.parametrize(("run", "reason"), [
    (service, "the start has a bug"), (short, "ended before it was ready|before ready"),
])
async def test_service_that_fails_before_it_is_ready_is_reported(run, reason: str) -> None:
    with pytest.raises(RuntimeError, match=reason):
        async with running_service(LocalNetwork(), run, Config(fail=True)):
            raise AssertionError("the block must not be entered")
    with pytest.raises(RuntimeError, match=reason):
        await wiring(run, Config(fail=True))


async def test_crash_in_the_middle_ends_the_block_and_is_raised() -> None:
    net = LocalNetwork()
    client = net.bus("tester").client(topics.TASK_COMMAND)

    async def block() -> None:
        async with running_service(net, service, Config()):
            asking = asyncio.create_task(client.call(STOP))
            asking.add_done_callback(lambda task: task.exception())
            await asyncio.Event().wait()

    with pytest.raises(RuntimeError, match="the handler has a bug"):
        await asyncio.wait_for(block(), TIMEOUT)


@pytest.mark.parametrize("error", [ZeroDivisionError, asyncio.CancelledError])
async def test_failure_or_cancellation_of_the_block_is_raised_as_it_is(error: type[BaseException]) -> None:
    async def block() -> None:
        async with running_service(LocalNetwork(), service, Config()):
            if error is ZeroDivisionError:
                raise error
            await asyncio.Event().wait()

    task = asyncio.create_task(block())
    await asyncio.sleep(0)
    if error is asyncio.CancelledError:
        task.cancel()
    with pytest.raises(error):
        await task


async def test_wiring_lists_topics_and_requests_of_a_service() -> None:
    found = await wiring(service, Config())
    assert (found.reads, found.writes) == ({topics.CAMERA_IMAGE}, {PICK_PLACE_STATUS})
    assert (found.serves, found.calls) == ({topics.TASK_COMMAND}, {topics.MOTION_PLAN})


async def test_buses_of_different_networks_or_cells_are_separate() -> None:
    net = LocalNetwork()
    net.bus("sender", cell="a").writer(PICK_PLACE_STATUS).put(PickPlaceStatus())
    assert net.bus("other", cell="b").reader(PICK_PLACE_STATUS).latest is None
    assert LocalNetwork().bus("other", cell="a").reader(PICK_PLACE_STATUS).latest is None
    assert net.bus("same", cell="a").reader(PICK_PLACE_STATUS).latest == PickPlaceStatus()


def test_former_writer_argument_of_topic_and_request_is_accepted_with_a_warning() -> None:
    with pytest.warns(DeprecationWarning, match="mine: leave 'my_service' out"):
        topic = Topic("mine", LogLine, "state", "my_service", "the doc")
    assert topic == Topic("mine", LogLine, "state", "the doc") and topic.doc == "the doc"
    with pytest.warns(DeprecationWarning, match="ask: leave 'my_service' out"):
        request = Request("ask", TaskCommand, TaskStatus, "my_service", "the doc")
    assert (request.doc, request.kind) == ("the doc", "request")
    assert replace(topic, key="other") == Topic("other", LogLine, "state", "the doc")
