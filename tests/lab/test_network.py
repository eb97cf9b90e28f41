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
from lab.network import GOOD_LINKS, POOR_LINKS, LinkQuality, SimulatedNetwork

HOLD = HoldRequest(hold=True)


class Net:
    """Network with named buses."""

    def __init__(self, loop, links):
        self.loop, self.network, self.sessions = loop, SimulatedNetwork(loop, 5, links), {}

    def bus(self, name):
        session = self.sessions[name] = self.network.attach(contextvars.copy_context(), name)
        return Bus(session, service=name, cell="test", clock=Clock())

    async def hold_client(self, handler):
        """Return a client of `MOTION_HOLD` that `handler` serves."""
        server, client = self.bus("server"), self.bus("client").client(MOTION_HOLD)
        server.serve(MOTION_HOLD, handler)
        await server.ready()
        await client.wait_available(5.0)
        return client

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


def run(main, links=GOOD_LINKS):
    loop = VirtualTimeLoop(5)

    async def run_and_clean_up():
        net = Net(loop, links)
        try:
            async with asyncio.timeout(1000.0):
                return await main(net)
        finally:
            rest = asyncio.all_tasks() - {asyncio.current_task()}
            for task in rest:
                task.cancel()
            await asyncio.gather(*rest, return_exceptions=True)

    with use_time_source(loop):
        try:
            return loop.run_until_complete(run_and_clean_up())
        finally:
            loop.close()


async def answer(_request):
    return MotionStatus()


async def never_answer(_request):
    await asyncio.sleep(100.0)
    return MotionStatus()


def test_events_over_poor_links_all_arrive_once_and_in_order():
    async def main(net):
        writer = net.bus("a").writer(SCENE_OBJECT_UPDATES)
        async with net.received("b") as texts:
            for number in range(2000):
                writer.put(SceneUpdate(data=f"remove:{number}"))
                await asyncio.sleep(0.001)
            await asyncio.sleep(5.0)
        return texts, net.network.counted

    texts, counted = run(main, POOR_LINKS)
    assert texts == [f"remove:{number}" for number in range(2000)]
    assert counted["duplicated"] and counted["delayed"]


def test_messages_of_two_writers_are_reordered():
    async def main(net):
        writers = [net.bus(name).writer(SCENE_OBJECT_UPDATES) for name in "ab"]
        async with net.received("c") as texts:
            for _ in range(200):
                for name, writer in zip("ab", writers, strict=True):
                    writer.put(SceneUpdate(data=f"remove:{name}"))
                await asyncio.sleep(0.1)
        pairs = {tuple(texts[i:i + 2]) for i in range(0, 400, 2)}
        return {pair for pair in pairs if len(set(pair)) == 2}

    assert len(run(main)) == 2


@pytest.mark.parametrize("fault", ["server crashes", "link of the client is cut"])
def test_open_request_is_lost_at_once(fault):
    async def main(net):
        client = await net.hold_client(never_answer)
        calling = asyncio.create_task(client.call(HOLD, timeout=50.0))
        await asyncio.sleep(1.0)
        if fault == "server crashes":
            net.network.detach(net.sessions["server"])
        else:
            net.network.cut([net.sessions["client"]])
        await asyncio.wait({calling})
        ended_at = net.loop.time()
        if fault == "server crashes":
            await asyncio.sleep(1.0)
            with pytest.raises(NoResponder):
                await client.call(HOLD)
        return type(calling.exception()), ended_at

    kind, ended_at = run(main)
    assert kind is RequestLost and ended_at < 3.0


def test_cut_link_loses_messages_and_recovers():
    async def main(net):
        a, b = net.bus("a"), net.bus("b")
        await a.ready()
        writer, reader = a.writer(MOTION_STATUS), b.reader(MOTION_STATUS)
        writer.put(MotionStatus(id="one"))
        await asyncio.sleep(0.5)
        assert reader.latest.id == "one" and await b.alive.known() == {"a"}
        net.network.cut([net.sessions["a"]])
        writer.put(MotionStatus(id="two"))
        await asyncio.sleep(3.0)
        during = reader.latest.id, b.alive.names, a.connected
        net.network.mend([net.sessions["a"]])
        await asyncio.sleep(1.5)  # a state is put again each second
        return during, (reader.latest.id, b.alive.names, a.connected)

    during, after = run(main)
    assert during == ("one", frozenset(), False)
    assert after == ("two", frozenset({"a"}), True)


def test_stalled_link_delays_but_loses_nothing():
    async def main(net):
        writer = net.bus("a").writer(SCENE_OBJECT_UPDATES)
        async with net.received("b") as texts:
            net.network.stall(net.sessions["b"], 1.5)
            for number in range(10):
                writer.put(SceneUpdate(data=f"remove:{number}"))
            await asyncio.sleep(1.5)
            during = len(texts)
            await asyncio.sleep(1.0)
        return during, texts

    assert run(main) == (0, [f"remove:{number}" for number in range(10)])


@pytest.mark.parametrize(("late", "first", "second"), [
    ("reply", (0.0, 0.1), (1.0, 1.1)), ("request", (2.5, 2.6), (2.5, 2.6)),
])
def test_late_request_or_reply_is_served_twice_and_never_overtaken(late, first, second):
    async def main(net):
        served = []

        async def hold(_request):
            served.append(net.loop.time() - started_at)
            return MotionStatus()

        client = await net.hold_client(hold)
        ends = net.sessions["client"], net.sessions["server"]
        net.network.delay_next_query(*(ends if late == "request" else reversed(ends)), "test/motion/hold", 2.5)
        started_at = net.loop.time()
        with pytest.raises(RequestTimeout):
            await client.call(HOLD, timeout=1.0)
        await client.call(HOLD, timeout=4.0)
        return served

    served = run(main)
    assert served == sorted(served)
    assert [low <= at < high for at, (low, high) in zip(served, (first, second), strict=True)] == [True, True]


def test_share_of_requests_is_late():
    async def main(net):
        client = await net.hold_client(answer)
        for _ in range(100):
            await client.call(HOLD, timeout=10.0)
        return net.network.counted

    assert 5 <= run(main, LinkQuality(late=0.1))["late"] <= 50
