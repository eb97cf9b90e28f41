"""A key is written or served by one service: a second one is refused when it becomes ready."""

import asyncio
import itertools
from dataclasses import replace
from unittest.mock import AsyncMock

import pytest

from common import topics
from common.errors import ConfigError
from common.messages import Header, PlanningScene, TaskCommand, TaskStatus
from common.transport import ownership
from common.transport.bus import Bus
from common.transport.codec import decode
from common.transport.local import LocalNetwork
from common.transport.ownership import Owner, Ownership, process_name, unique_owners
from common.transport.session import Declaration, owns_key
from tests.common.transport.conftest import TIMEOUT, NewBus, next_of, until

KEY = topics.CAMERA_IMAGE.key


@pytest.fixture(autouse=True)
def _claim_without_waiting(monkeypatch):
    monkeypatch.setattr(ownership, "CLAIM_SECONDS", 0.0)


async def obey(_: TaskCommand) -> TaskStatus:
    return TaskStatus()


async def both_writing(new_bus: NewBus, *names: str) -> list[Bus]:
    buses = [await new_bus(name) for name in names]
    for bus in buses:
        bus.writer(topics.CAMERA_IMAGE)
    return buses


async def test_second_writer_is_refused_with_both_names_and_a_remedy(new_bus) -> None:
    left, right = await both_writing(new_bus, "left_camera", "right_camera")
    await left.ready()
    with pytest.raises(ConfigError) as refused:
        await right.ready()
    assert str(refused.value) == (
        "services.right_camera: left_camera has camera/image_raw already, and a key is written or served by one "
        "service: give right_camera or left_camera keys of its own, as in topics: {camera/*: right_camera/*}")
    assert (await left.alive.known()) == {"left_camera"}


async def test_second_server_is_refused_and_so_is_a_second_process_of_one_name(new_bus) -> None:
    first, second = await new_bus("task"), await new_bus("task")
    for bus in (first, second):
        bus.serve(topics.TASK_COMMAND, obey)
    await first.ready()
    with pytest.raises(ConfigError, match=r"services\.task: another task is up, which has task/command already"):
        await second.ready()


async def test_deferred_messages_are_published_once_the_key_is_acquired(new_bus, monkeypatch) -> None:
    first, second, listener = await new_bus("scene"), await new_bus("scene"), await new_bus("listener")
    received = listener.reader(topics.PLANNING_SCENE)
    await listener.ready()
    for number, bus in enumerate((first, second), 1):
        bus.defer_writes()
        writer = bus.writer(topics.PLANNING_SCENE)
        for stamp in (1, 10 * number):  # only the newest of a state is published
            writer.put(PlanningScene(header=Header(stamp=stamp)))
    await first.ready()
    assert (await next_of(received)).header.stamp == 10
    with pytest.raises(ConfigError):
        await second.ready()
    replies = await listener.raw_get(first.full_key(topics.PLANNING_SCENE), TIMEOUT)
    assert [decode(PlanningScene, sample.payload).header.stamp for sample in replies] == [10]
    assert received.latest is not None and received.latest.header.stamp == 10
    monkeypatch.setattr(ownership, "CLAIM_SECONDS", 10.0)  # tokens of a closed bus vanish late
    await first.close()
    await second.acquire_keys()
    assert (await next_of(received)).header.stamp == 20


async def test_each_service_owns_its_log_and_counters_and_readers_own_nothing(new_bus) -> None:
    [writer] = await both_writing(new_bus, "writer")
    reader = await new_bus("reader")
    reader.reader(topics.CAMERA_IMAGE)
    for bus in (writer, reader):
        for each in (topics.LOG, topics.SUPERVISOR_STATUS):
            bus.writer(each)
        await bus.ready()
    assert [(owner.key, owner.own, owner.service) for owner in await reader.owners()] == [
        *((f"{key}/reader", f"{key}/reader", "reader") for key in ("counters", "log")), (KEY, KEY, "writer"),
        *((f"{key}/writer", f"{key}/writer", "writer") for key in ("counters", "log"))]


async def test_own_keys_are_known_without_a_reply_of_the_network(new_bus, monkeypatch) -> None:
    [bus] = await both_writing(new_bus, "writer")
    monkeypatch.setattr(ownership, "tokens_now", AsyncMock(return_value=[]))
    assert await bus.owners() == []  # it is not ready yet
    await bus.ready()
    assert [owner.key for owner in await bus.owners()] == [KEY, "counters/writer"]


async def test_owners_have_the_remapped_key_and_that_of_the_code() -> None:
    net = LocalNetwork()
    camera = net.bus("left", topics={"camera/*": "left/camera/*"})
    camera.writer(topics.CAMERA_IMAGE)
    await camera.ready()
    camera.writer(topics.CAMERA_INFO)  # after it became ready
    assert {(owner.key, owner.own) for owner in await net.bus("tool").owners()} == {
        ("left/camera/image_raw", "camera/image_raw"), ("left/camera/camera_info", "camera/camera_info"),
        ("counters/left", "counters/left")}


async def test_second_writer_waits_until_the_first_has_closed(new_bus, monkeypatch) -> None:
    monkeypatch.setattr(ownership, "CLAIM_SECONDS", 20.0)
    before, after = await both_writing(new_bus, "camera", "camera")
    await before.ready()
    checked, original = asyncio.Event(), Ownership.owners

    async def owners(ownership: Ownership, *keys: str) -> list[Owner]:
        found = await original(ownership, *keys)
        checked.set()
        return found

    monkeypatch.setattr(Ownership, "owners", owners)
    becoming = asyncio.create_task(after.ready())
    await checked.wait()
    assert not becoming.done()
    await before.close()
    await asyncio.wait_for(becoming, TIMEOUT)


async def test_two_services_that_start_at_once_are_never_both_ready(new_bus) -> None:
    buses = await both_writing(new_bus, "camera_0", "camera_1")
    ended = await asyncio.gather(*(bus.ready() for bus in buses), return_exceptions=True)
    assert any(isinstance(each, ConfigError) for each in ended)


async def test_claiming_server_receives_no_requests_of_the_ready_one(new_bus, monkeypatch) -> None:
    monkeypatch.setattr(ownership, "CLAIM_SECONDS", 20.0)
    first, second, tool = await new_bus("task"), await new_bus("task"), await new_bus("tool")

    async def must_not_be_called(_: TaskCommand) -> TaskStatus:
        raise AssertionError("a server that is not ready was called")

    first.serve(topics.TASK_COMMAND, obey)
    second.serve(topics.TASK_COMMAND, must_not_be_called)
    await first.ready()
    claiming = asyncio.create_task(second.ready())
    client = tool.client(topics.TASK_COMMAND)
    await client.wait_available(TIMEOUT)
    for _ in range(5):
        assert await client.call(TaskCommand(command="start"), TIMEOUT) == TaskStatus()
    assert not claiming.done()
    claiming.cancel()


def test_token_names_its_owner_and_the_earliest_ready_process_precedes() -> None:
    owner = Owner("left/image_raw", KEY, "left", process_name("a1", 7))
    assert Owner.of(f"panda{owner.token}") == owner
    assert owner.instance == "a1" and not owner.claiming and replace(owner, process=process_name("a2")).claiming
    names = [process_name(*each) for each in (("b", 5), ("a", 6), ("c", 6), ("a0", None))]
    for earlier, later in itertools.combinations([replace(owner, process=name) for name in names], 2):
        assert earlier.precedes(later) and not later.precedes(earlier)


def test_process_with_a_claiming_and_a_ready_token_is_one_owner() -> None:
    claiming = Owner("joint_states", "joint_states", "executor", process_name("abc"))
    ready, other = (replace(claiming, process=name) for name in (process_name("abc", since=7), process_name("def")))
    for seen in itertools.permutations((claiming, ready, other)):
        assert sorted(unique_owners(seen), key=lambda owner: owner.instance)[:1] == [ready]
        assert {owner.instance for owner in unique_owners(seen)} == {"abc", "def"}


class Split:
    """Two networks of one cell that can be joined, each with a service of the same name."""

    def __init__(self) -> None:
        self.nets = LocalNetwork(), LocalNetwork()
        self.running: list[asyncio.Task[None]] = []

    async def start(self, side: int) -> None:
        bus = self.nets[side].bus("arm")
        bus.serve(topics.TASK_COMMAND, obey)
        bus.writer(topics.JOINT_STATES)

        async def run() -> None:
            await bus.ready()
            await asyncio.Event().wait()

        self.running.append(asyncio.create_task(bus.run(run())))
        await bus.ready_event.wait()

    def join(self) -> list[Declaration]:
        """Declare the tokens of each side on the other; return those declared on the first side."""
        tokens = [list(net.tokens) for net in self.nets]
        declared = []
        for net, theirs in zip(self.nets, reversed(tokens), strict=True):
            session = net.session()
            declared.append([session.token(entry.key) for entry in theirs])
        return declared[0]


@pytest.fixture
async def split():
    split = Split()
    yield split
    for task in split.running:
        task.cancel()


@pytest.mark.parametrize("first", [0, 1])
async def test_first_service_survives_when_a_split_network_heals(split, monkeypatch, caplog, first: int) -> None:
    monkeypatch.setattr(ownership, "CONFLICT_SECONDS", 0.0)
    for side in (first, 1 - first):
        await split.start(side)
    split.join()
    with pytest.raises(ConfigError, match=r"services\.arm: another arm .* was there first: this one ends"):
        await asyncio.wait_for(split.running[1], TIMEOUT)
    assert not split.running[0].done() and caplog.text.count("gives way: this one was there first") == 1


async def test_first_service_reports_a_second_one_that_has_ended_already_but_no_short_claim(split, caplog) -> None:
    await split.start(0)
    session = split.nets[0].session()
    for process in (process_name("claims"), process_name("before", since=7)):
        session.token(owns_key("test", topics.JOINT_STATES.key, topics.JOINT_STATES.key, "arm", process)).undeclare()
    await asyncio.sleep(0.01)
    assert "first" not in caplog.text and not split.running[0].done()
    await split.start(1)
    for token in split.join():
        token.undeclare()
    await until(lambda: caplog.text.count("gives way: this one was there first") == 1)


async def test_second_service_is_refused_and_reported_by_the_first(split, monkeypatch, caplog) -> None:
    monkeypatch.setattr(ownership, "CONFLICT_SECONDS", 0.0)
    monkeypatch.setattr(ownership, "CLAIM_SECONDS", 0.1)
    await split.start(0)
    second = split.nets[0].bus("arm")
    second.serve(topics.TASK_COMMAND, obey)
    with pytest.raises(ConfigError, match="another arm is up"):
        await second.ready()
    assert "another arm (process" in caplog.text and not split.running[0].done()
