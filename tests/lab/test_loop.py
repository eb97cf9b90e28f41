"""Event loop on virtual time."""

import asyncio
import time

import pytest

from common.time_source import monotonic, new_id, use_time_source
from lab.loop import CLOCK_READ_NS, EPOCH_NS, Deadlock, Incarnation, VirtualTimeLoop, context_of


def run(main, seed=1, *, shuffled=False):
    loop = VirtualTimeLoop(seed, shuffled=shuffled)
    with use_time_source(loop):
        try:
            return loop.run_until_complete(main(loop))
        finally:
            loop.close()


def test_time_advances_to_the_next_timer_once_no_callback_is_ready():
    async def main(loop):
        for _ in range(1000):
            await asyncio.sleep(0)
        assert loop.time() == 0.0
        order = []
        for delay in (0.3, 0.1, 0.2):
            loop.call_later(delay, order.append, delay)
        await asyncio.sleep(3600.0)
        assert order == [0.1, 0.2, 0.3] and (loop.time(), loop.wall_ns()) == (3600.0, EPOCH_NS + 3600 * 10**9)

    started_at = time.monotonic()
    run(main)
    assert time.monotonic() - started_at < 60.0


def test_waiting_with_nothing_scheduled_is_a_deadlock():
    async def main(loop):
        await asyncio.Event().wait()

    with pytest.raises(Deadlock, match="nothing is scheduled"):
        run(main)


def test_ids_and_durations_of_thread_calls_come_from_the_seed():
    async def main(loop):
        await asyncio.to_thread(lambda: None)
        return new_id(8), loop.time()

    assert run(main, 1) == run(main, 1) != run(main, 2)


def test_clock_reads_count_as_work_of_a_thread_call():
    async def main(loop):
        def work():
            deadline, reads = monotonic() + 1.0, 1
            while monotonic() < deadline:
                reads += 1
            return reads

        return await asyncio.to_thread(work), loop.time()

    reads, took = run(main)
    assert reads == pytest.approx(1e9 / CLOCK_READ_NS, abs=2) and took >= 1.0



class Victim:
    """Task of its own incarnation that lists what it has done."""

    def __init__(self, loop):
        self.incarnation, self.done, self.loop = Incarnation("victim"), [], loop
        self.task = context_of(self.incarnation).run(lambda: loop.create_task(self.work()))

    async def work(self):
        try:
            for number in range(100):
                self.done.append(number)
                await asyncio.sleep(1.0)
        finally:
            self.done.append("end")

    async def clean_up(self):
        self.loop.revive(self.incarnation)
        self.task.cancel()
        await asyncio.wait({self.task})


def test_killed_incarnation_runs_nothing_more_until_it_is_revived():
    async def main(loop):
        victim = Victim(loop)
        await asyncio.sleep(2.5)
        loop.end(victim.incarnation)
        await asyncio.sleep(10.0)
        assert victim.done == [0, 1, 2]
        await victim.clean_up()
        assert victim.done == [0, 1, 2, "end"]

    run(main)


def test_incarnation_is_killed_at_a_given_turn():
    async def main(loop):
        victim = Victim(loop)
        victim.incarnation.at_turn = victim.incarnation.turns + 3, lambda: loop.end(victim.incarnation)
        await asyncio.sleep(50.0)
        assert 1 <= len(victim.done) < 10
        await victim.clean_up()

    run(main)


def test_paused_incarnation_runs_its_timers_in_order_after_the_pause():
    async def main(loop):
        incarnation, ran = Incarnation("paused"), []
        incarnation.paused_until = 1.0
        for delay in (0.2, 0.1, 1.5):
            loop.call_later(delay, lambda own=delay: ran.append((own, loop.time())), context=context_of(incarnation))
        await asyncio.sleep(0.5)
        assert ran == []
        await asyncio.sleep(2.0)
        assert ran == [(0.1, 1.0), (0.2, 1.0), (1.5, 1.5)]

    run(main)


def order_of_turns(seed, *, shuffled=True):
    async def main(loop):
        order, contexts = [], {name: context_of(Incarnation(name)) for name in "abc"}
        for turn in range(5):
            for name, context in contexts.items():
                loop.call_soon(order.append, (name, turn), context=context)
        for name, context in contexts.items():
            loop.call_later(1.0, order.append, (name, 5), context=context)
        await asyncio.sleep(2.0)
        return order

    return run(main, seed, shuffled=shuffled)


def test_shuffling_interleaves_incarnations_and_keeps_the_order_of_each():
    orders = [order_of_turns(seed) for seed in range(20)]
    assert len({tuple(order) for order in orders}) == 20
    for order in orders:
        for owner in "abc":
            assert [turn for name, turn in order if name == owner] == list(range(6))
    assert order_of_turns(7) == orders[7]
    assert order_of_turns(3, shuffled=False)[:3] == [("a", 0), ("b", 0), ("c", 0)]


def test_sets_of_tasks_iterate_in_the_same_order_in_every_run():
    async def main(loop):
        tasks = [loop.create_task(asyncio.sleep(0)) for _ in range(50)]
        await asyncio.wait(set(tasks))
        return [hash(task) for task in tasks]

    assert run(main) == run(main)
