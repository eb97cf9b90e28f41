"""Links of the simulated network: what they do to messages, and what they must not do."""

import asyncio
import contextvars
from contextlib import asynccontextmanager

import pytest

from common.clock import Clock
from common.errors import NoResponder, RequestLost, RequestTimeout
from common.messages import HoldRequest, MotionStatus, SceneUpdate
from common.time_source import use_time_source
from common.topics import MOTION_HOLD, MOTION_STATUS, SCENE_OBJECT_UPDATES
from common.transport.bus import Bus
from lab.loop import VirtualTimeLoop
from lab.network import GOOD_LINKS, POOR_LINKS, SimulatedNetwork

HOLD = HoldRequest(hold=True)


class Net:
    """Network with named buses."""

    def __init__(self, loop, links):
        self.loop, self.network, self.sessions = loop, SimulatedNetwork(loop, 5, links), {}

    def bus(self, name):
        session = self.sessions[name] = self.network.attach(contextvars.copy_context(), name)
        return Bus(session, service=name, cell="test", clock=Clock())

    async def hold_client(self, seconds=0.0):
        """Return a client of `MOTION_HOLD` that is answered after some seconds, and the times of its requests."""
        served = []

        async def hold(_request):
            served.append(self.loop.time())
            await asyncio.sleep(seconds)
            return MotionStatus()

        server, client = self.bus("server"), self.bus("client").client(MOTION_HOLD)
        server.serve(MOTION_HOLD, hold)
        await server.ready()
        await client.wait_available(5.0)
        return client, served

    @asynccontextmanager
    async def received(self, name):
        """Texts of the scene updates that arrive at a bus during the block."""
        texts, reader = [], self.bus(name).reader(SCENE_OBJECT_UPDATES)

        async def read():
            async for update in reader:
                texts.append(update.data)

        reading = asyncio.create_task(read())
        try:
            yield texts
        finally:
            reading.cancel()


def on_links(links=GOOD_LINKS):
    """Run a test on virtual time, with a network of such links."""
    def decorate(test):
        def run(**parameters):
            loop = VirtualTimeLoop(5)

            async def run_and_clean_up():
                try:
                    async with asyncio.timeout(1000.0):
                        await test(Net(loop, links), **parameters)
                finally:
                    others = asyncio.all_tasks() - {asyncio.current_task()}
                    for task in others:
                        task.cancel()
                    await asyncio.gather(*others, return_exceptions=True)

            with use_time_source(loop):
                try:
                    loop.run_until_complete(run_and_clean_up())
                finally:
                    loop.close()

        return run
    return decorate


def put(writer, *updates):
    for update in updates:
        writer.put(SceneUpdate(data=f"remove:{update}"))


@on_links(POOR_LINKS)
async def test_events_over_poor_links_all_arrive_once_and_in_order(net):
    writer = net.bus("a").writer(SCENE_OBJECT_UPDATES)
    async with net.received("b") as texts:
        for number in range(500):
            put(writer, number)
            await asyncio.sleep(0.001)
        await asyncio.sleep(5.0)
    assert texts == [f"remove:{number}" for number in range(500)]
    assert net.network.counted["duplicated"] and net.network.counted["delayed"]


@on_links()
async def test_messages_of_two_writers_are_reordered(net):
    writers = [net.bus(name).writer(SCENE_OBJECT_UPDATES) for name in "ab"]
    async with net.received("c") as texts:
        for _ in range(200):
            for name, writer in zip("ab", writers, strict=True):
                put(writer, name)
            await asyncio.sleep(0.1)
    assert {("remove:a", "remove:b"), ("remove:b", "remove:a")} <= {tuple(texts[i:i + 2]) for i in range(0, 400, 2)}


def test_open_request_is_lost_at_once():
    for crash in (True, False):
        assert_open_request_is_lost_at_once(crash=crash)


@on_links()
async def assert_open_request_is_lost_at_once(net, crash):
    client, _ = await net.hold_client(100.0)
    calling = asyncio.create_task(client.call(HOLD, timeout=50.0))
    await asyncio.sleep(1.0)
    if crash:
        net.network.detach(net.sessions["server"])
    else:
        net.network.cut([net.sessions["client"]])
    with pytest.raises(RequestLost):
        await calling
    assert net.loop.time() < 3.0
    if crash:
        await asyncio.sleep(1.0)
        with pytest.raises(NoResponder):
            await client.call(HOLD)


@on_links()
async def test_cut_link_loses_messages_and_recovers(net):
    a, b = net.bus("a"), net.bus("b")
    await a.ready()
    writer, reader = a.writer(MOTION_STATUS), b.reader(MOTION_STATUS)
    writer.put(MotionStatus(id="one"))
    await asyncio.sleep(0.5)
    assert reader.latest.id == "one" and await b.alive.known() == {"a"}
    net.network.cut([net.sessions["a"]])
    writer.put(MotionStatus(id="two"))
    await asyncio.sleep(3.0)
    assert (reader.latest.id, b.alive.names, a.connected) == ("one", frozenset(), False)
    net.network.mend([net.sessions["a"]])
    await asyncio.sleep(1.5)  # a state is put again each second
    assert (reader.latest.id, b.alive.names, a.connected) == ("two", frozenset({"a"}), True)


@on_links()
async def test_stalled_link_delays_but_loses_nothing(net):
    writer = net.bus("a").writer(SCENE_OBJECT_UPDATES)
    async with net.received("b") as texts:
        net.network.stall(net.sessions["b"], 1.5)
        put(writer, *range(10))
        await asyncio.sleep(1.5)
        assert texts == []
        await asyncio.sleep(1.0)
    assert texts == [f"remove:{number}" for number in range(10)]


def test_late_request_or_reply_is_served_twice_and_never_overtaken():
    assert_delayed_is_served_twice(ends=("server", "client"), times=(0.0, 1.0))
    assert_delayed_is_served_twice(ends=("client", "server"), times=(2.5, 2.5))


@on_links()
async def assert_delayed_is_served_twice(net, ends, times):
    client, served = await net.hold_client()
    net.network.delay_next_query(*(net.sessions[end] for end in ends), "test/motion/hold", 2.5)
    began = net.loop.time()
    with pytest.raises(RequestTimeout):
        await client.call(HOLD, timeout=1.0)
    await client.call(HOLD, timeout=4.0)
    assert served == sorted(served) and [at - began for at in served] == pytest.approx(times, abs=0.1)
