"""The loop on whose clock no time passes while anything can be done."""

import asyncio
import time

import pytest

from common.sources import drawn_from, monotonic, new_id
from lab.loop import EPOCH_NS, LOOK_NS, Deadlock, Incarnation, VirtualTimeLoop, context_of


def run(main, seed=1, *, shuffled=False):
    loop = VirtualTimeLoop(seed, shuffled=shuffled)
    with drawn_from(loop):
        try:
            return loop.run_until_complete(main(loop))
        finally:
            loop.close()


def test_an_hour_takes_no_time():
    async def main(loop):
        await asyncio.sleep(3600.0)
        return loop.time(), loop.wall_ns()

    began = time.monotonic()
    assert run(main) == (3600.0, EPOCH_NS + 3600 * 10**9)
    assert time.monotonic() - began < 60.0


def test_time_stands_still_while_something_can_be_done():
    async def main(loop):
        for _ in range(1000):
            await asyncio.sleep(0)
        return loop.time()

    assert run(main) == 0.0


def test_timers_come_in_their_order():
    async def main(loop):
        order = []
        for delay in (0.3, 0.1, 0.2):
            loop.call_later(delay, order.append, delay)
        await asyncio.sleep(1.0)
        return order

    assert run(main) == [0.1, 0.2, 0.3]


def test_waiting_for_what_never_comes_is_a_deadlock():
    async def main(loop):
        await asyncio.Event().wait()

    with pytest.raises(Deadlock, match="nothing will ever happen"):
        run(main)


def test_ids_and_durations_come_from_the_seed():
    async def main(loop):
        await asyncio.to_thread(lambda: None)
        return new_id(8), loop.time()

    assert run(main, 1) == run(main, 1)
    assert run(main, 1) != run(main, 2)


def test_looks_at_the_clock_count_as_work_of_a_call_beside_the_loop():
    async def main(loop):
        def work():
            deadline = monotonic() + 1.0
            looks = 1
            while monotonic() < deadline:
                looks += 1
            return looks

        looks = await asyncio.to_thread(work)
        return looks, loop.time()

    looks, took = run(main)
    assert looks == pytest.approx(1e9 / LOOK_NS, abs=2)
    assert took >= 1.0


def test_error_of_a_call_beside_the_loop_comes_to_who_waits():
    async def main(loop):
        def work():
            raise ValueError("broken")

        with pytest.raises(ValueError, match="broken"):
            await asyncio.to_thread(work)

    run(main)


class Victim:
    """A task of a life of its own that notes what it does."""

    def __init__(self, loop):
        self.life, self.did = Incarnation("victim"), []
        self.task = context_of(self.life).run(lambda: loop.create_task(self.work()))

    async def work(self):
        try:
            for number in range(100):
                self.did.append(number)
                await asyncio.sleep(1.0)
        finally:
            self.did.append("end")


def test_life_that_is_cut_off_does_nothing_more_not_even_at_its_end():
    async def main(loop):
        victim = Victim(loop)
        await asyncio.sleep(2.5)
        loop.end(victim.life)
        await asyncio.sleep(10.0)
        done = list(victim.did)
        loop.revive(victim.life)
        victim.task.cancel()
        await asyncio.wait({victim.task})
        return done, victim.did

    done, cleared = run(main)
    assert done == [0, 1, 2]
    assert cleared == [0, 1, 2, "end"]


def test_life_ends_at_the_turn_that_was_said():
    async def main(loop):
        victim = Victim(loop)
        victim.life.at_turn = victim.life.turns + 3, lambda: loop.end(victim.life)
        await asyncio.sleep(50.0)
        done = list(victim.did)
        loop.revive(victim.life)
        victim.task.cancel()
        await asyncio.wait({victim.task})
        return done

    assert 1 <= len(run(main)) < 10


def order_of_turns(seed, *, shuffled=True):
    async def main(loop):
        order, contexts = [], [context_of(Incarnation(name)) for name in "abc"]
        for turn in range(5):
            for name, context in zip("abc", contexts, strict=True):
                loop.call_soon(order.append, (name, turn), context=context)
        for name, context in zip("abc", contexts, strict=True):
            loop.call_later(1.0, order.append, (name, 5), context=context)
        await asyncio.sleep(2.0)
        return order

    return run(main, seed, shuffled=shuffled)


def test_lives_take_the_turns_that_are_due_at_once_in_any_order_each_its_own_in_theirs():
    orders = [order_of_turns(seed) for seed in range(20)]
    assert len({tuple(order) for order in orders}) == 20
    for order in orders:
        for life in "abc":
            assert [turn for name, turn in order if name == life] == list(range(6))
    assert order_of_turns(7) == order_of_turns(7)


def test_turns_that_are_not_shuffled_come_as_they_were_made():
    assert order_of_turns(3, shuffled=False)[:3] == [("a", 0), ("b", 0), ("c", 0)]


def test_sets_of_tasks_are_walked_in_the_same_order_in_every_process():
    async def main(loop):
        tasks = [loop.create_task(asyncio.sleep(0)) for _ in range(50)]
        await asyncio.wait(set(tasks))
        return [hash(task) for task in tasks]

    assert run(main) == run(main)
