"""What links of the simulated network may do, and what not."""

import asyncio
import contextvars

from common.clock import Clock
from common.errors import NoResponder, RequestLost, RequestTimeout
from common.messages import HoldRequest, MotionStatus, SceneUpdate
from common.sources import drawn_from
from common.topics import MOTION_HOLD, MOTION_STATUS, SCENE_OBJECT_UPDATES
from common.transport.bus import Bus
from lab.loop import VirtualTimeLoop
from lab.network import GOOD_LINKS, POOR_LINKS, LinkQuality, SimulatedNetwork


class Net:
    """A network with buses that have names."""

    def __init__(self, loop, weather):
        self.loop, self.network, self.sessions = loop, SimulatedNetwork(loop, 5, weather), {}

    def bus(self, name):
        session = self.sessions[name] = self.network.attach(contextvars.copy_context(), name)
        return Bus(session, service=name, cell="test", clock=Clock())


def run(main, weather=GOOD_LINKS):
    loop = VirtualTimeLoop(5)

    async def whole():
        net = Net(loop, weather)
        try:
            async with asyncio.timeout(1000.0):
                return await main(net)
        finally:
            left = asyncio.all_tasks() - {asyncio.current_task()}
            for task in left:
                task.cancel()
            await asyncio.gather(*left, return_exceptions=True)

    with drawn_from(loop):
        try:
            return loop.run_until_complete(whole())
        finally:
            loop.close()


async def read_all(reader, into):
    async for message in reader:
        into.append(message)


def test_events_arrive_late_in_order_and_all_of_them_in_foul_weather():
    async def main(net):
        writer, reader = net.bus("a").writer(SCENE_OBJECT_UPDATES), net.bus("b").reader(SCENE_OBJECT_UPDATES)
        came = []
        reading = asyncio.create_task(read_all(reader, came))
        for number in range(2000):
            writer.put(SceneUpdate(data=f"remove:{number}"))
            await asyncio.sleep(0.001)
        await asyncio.sleep(5.0)
        reading.cancel()
        return [update.data for update in came], net.network.counted

    came, counted = run(main, POOR_LINKS)
    assert came == [f"remove:{number}" for number in range(2000)]
    assert counted["doubled"] and counted["held up"]


def test_messages_of_two_writers_change_places():
    async def main(net):
        one, two = net.bus("a").writer(SCENE_OBJECT_UPDATES), net.bus("b").writer(SCENE_OBJECT_UPDATES)
        came = []
        reading = asyncio.create_task(read_all(net.bus("c").reader(SCENE_OBJECT_UPDATES), came))
        for _ in range(200):
            one.put(SceneUpdate(data="remove:one"))
            two.put(SceneUpdate(data="remove:two"))
            await asyncio.sleep(0.1)
        reading.cancel()
        pairs = [tuple(update.data for update in came[i:i + 2]) for i in range(0, 400, 2)]
        return {pair for pair in pairs if len(set(pair)) == 2}

    assert len(run(main)) == 2


def test_request_to_a_process_that_ends_without_a_word_is_lost():
    async def main(net):
        server, client = net.bus("server"), net.bus("client").client(MOTION_HOLD)

        async def never(request):
            await asyncio.sleep(100.0)
            return MotionStatus()

        server.serve(MOTION_HOLD, never)
        await server.ready()
        await client.wait_available(5.0)
        asking = asyncio.create_task(client.call(HoldRequest(hold=True), timeout=50.0))
        await asyncio.sleep(1.0)
        net.network.detach(net.sessions["server"])
        await asyncio.wait({asking})
        ended = net.loop.time()
        await asyncio.sleep(1.0)
        try:
            await client.call(HoldRequest(hold=True))
        except NoResponder:
            return type(asking.exception()), ended
        raise AssertionError("somebody still answers")

    kind, ended = run(main)
    assert kind is RequestLost and ended < 3.0


def test_cut_link_loses_what_is_under_way_and_heals():
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
        before = reader.latest.id, b.alive.names, a.connected
        net.network.mend([net.sessions["a"]])
        await asyncio.sleep(1.5)  # a state is put again each second
        return before, (reader.latest.id, b.alive.names, a.connected)

    before, after = run(main)
    assert before == ("one", frozenset(), False)
    assert after == ("two", frozenset({"a"}), True)


def test_who_asks_over_a_link_that_is_cut_hears_that_it_is_lost():
    async def main(net):
        server, bus = net.bus("server"), net.bus("client")
        client = bus.client(MOTION_HOLD)

        async def never(request):
            await asyncio.sleep(100.0)
            return MotionStatus()

        server.serve(MOTION_HOLD, never)
        await server.ready()
        await client.wait_available(5.0)
        asking = asyncio.create_task(client.call(HoldRequest(hold=True), timeout=50.0))
        await asyncio.sleep(1.0)
        net.network.cut([net.sessions["client"]])
        await asyncio.wait({asking})
        return type(asking.exception()), net.loop.time()

    kind, ended = run(main)
    assert kind is RequestLost and ended < 3.0


def test_link_that_is_stalled_loses_nothing():
    async def main(net):
        writer, reader = net.bus("a").writer(SCENE_OBJECT_UPDATES), net.bus("b").reader(SCENE_OBJECT_UPDATES)
        came = []
        reading = asyncio.create_task(read_all(reader, came))
        net.network.stall(net.sessions["b"], 1.5)
        for number in range(10):
            writer.put(SceneUpdate(data=f"remove:{number}"))
        await asyncio.sleep(1.5)
        before = len(came)
        await asyncio.sleep(1.0)
        reading.cancel()
        return before, [update.data for update in came]

    assert run(main) == (0, [f"remove:{number}" for number in range(10)])


async def ask_twice(net, late):
    """What a server was asked and when [s], by a client that asks again after a second; `late` says what is late."""
    server, bus, served = net.bus("server"), net.bus("client"), []
    client = bus.client(MOTION_HOLD)

    async def hold(request):
        served.append(net.loop.time() - began)
        return MotionStatus()

    server.serve(MOTION_HOLD, hold)
    await server.ready()
    await client.wait_available(5.0)
    ends = net.sessions["client"], net.sessions["server"]
    net.network.hold_up(*(ends if late == "request" else reversed(ends)), "test/motion/hold", 2.5)
    began = net.loop.time()
    try:
        await client.call(HoldRequest(hold=True), timeout=1.0)
    except RequestTimeout:
        await client.call(HoldRequest(hold=True), timeout=4.0)
    return served


def test_request_whose_answer_is_late_is_done_and_asked_again():
    async def main(net):
        return await ask_twice(net, "answer")

    first, again = run(main)
    assert first < 0.1 and 1.0 <= again < 1.1


def test_request_that_is_late_is_not_overtaken_by_the_next_under_its_key():
    async def main(net):
        return await ask_twice(net, "request")

    first, again = run(main)
    assert 2.5 <= first <= again < 2.6


def test_requests_are_late_in_such_weather():
    async def main(net):
        client, server = net.bus("client").client(MOTION_HOLD), net.bus("server")

        async def hold(request):
            return MotionStatus()

        server.serve(MOTION_HOLD, hold)
        await server.ready()
        await client.wait_available(5.0)
        for _ in range(100):
            await client.call(HoldRequest(hold=True), timeout=10.0)
        return net.network.counted

    assert 5 <= run(main, LinkQuality(late=0.1))["late"] <= 50
