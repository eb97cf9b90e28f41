"""However many liveliness tokens somebody declares, and however odd: nobody has much to do with them on the loop."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from common import topics
from common.errors import ConfigError
from common.messages import TaskCommand, TaskStatus
from common.transport import ownership
from common.transport.bus import Bus
from common.transport.local import LocalNetwork, LocalSession
from common.transport.ownership import MAX_OTHERS, MAX_WARNINGS, Owner, Ownership
from common.transport.session import alive_key, owns_key
from common.transport.tokens import MAX_NAMES, MAX_PER_TURN, TokenWatch

NewBus = Callable[..., Awaitable[Bus]]
FLOOD = 3000  # counts, not seconds: as many more would be the same
LATER = 2**63  # [ns] than every real one
ODD = ("0", "-", "zz", "-1--1", "|", "%s", "[bold]", "\x1b[31m", "\u202e", "a" * 1000)


async def obey(_: TaskCommand) -> TaskStatus:
    return TaskStatus()


def forged(number: int, key: str = "camera/image_raw", service: str = "camera", *, cell: str = "test") -> str:
    """A token that a camera's certificate lets it declare, with a word and a process of its own choice."""
    return owns_key(cell, key, f"k{number}", service, f"{LATER + number:016x}-{number:08x}")


class Watched:
    """The changes that a watch of the services that are ready tells of, in which turn of the loop."""

    def __init__(self, session: LocalSession) -> None:
        self.changes: list[tuple[str, bool]] = []
        self.most_at_once = 0
        self._at_once = 0
        self.watch = TokenWatch(session, alive_key("test"), asyncio.get_running_loop())
        self.watch.on_change(self._take)

    def _take(self, name: str, there: bool) -> None:
        self.changes.append((name, there))
        self._at_once += 1
        if self._at_once == 1:
            asyncio.get_running_loop().call_soon(self._turn)

    def _turn(self) -> None:
        self.most_at_once, self._at_once = max(self.most_at_once, self._at_once), 0

    async def settled(self) -> None:
        """Return when all that came before was told."""
        for _ in range(2 + MAX_NAMES // MAX_PER_TURN):
            await asyncio.sleep(0)


async def test_watch_tells_of_a_few_names_in_a_turn_and_of_some_in_all(caplog: pytest.LogCaptureFixture) -> None:
    net = LocalNetwork()
    watched, flooder = Watched(net.session()), net.session()
    for number in range(FLOOD):
        flooder.token(alive_key("test", f"n{number}"))
    await watched.settled()
    assert 0 < watched.most_at_once <= MAX_PER_TURN
    assert len(watched.changes) == len(watched.watch.names) == MAX_NAMES
    assert watched.watch.left_out == FLOOD - MAX_NAMES and caplog.text.count("further ones are left out") == 1
    flooder.close()
    await watched.settled()
    token = net.session().token(alive_key("test", "camera"))
    await watched.settled()
    assert watched.watch.names == {"camera"}
    token.undeclare()
    await watched.settled()
    assert not watched.watch.names


@pytest.mark.parametrize("extra", [0, 1])
async def test_name_that_comes_and_goes_all_the_time_is_told_of_once(extra: int) -> None:
    net = LocalNetwork()
    watched, flooder = Watched(net.session()), net.session()
    stays = net.session().token(alive_key("test", "task"))
    await watched.settled()
    stays.undeclare()
    net.session().token(alive_key("test", "task"))
    for _ in range(FLOOD // 10):
        flooder.token(alive_key("test", "camera")).undeclare()
    if extra:
        flooder.token(alive_key("test", "camera"))
    await watched.settled()
    assert watched.changes[:3] == [("task", True), ("task", False), ("task", True)]  # who came back had been gone
    assert watched.changes[3:] == ([("camera", True)] if extra else [("camera", True), ("camera", False)])
    assert watched.watch.names == {"task", *["camera"] * extra}


async def test_tokens_of_a_key_never_come_to_who_has_other_keys(
    new_bus: NewBus, monkeypatch: pytest.MonkeyPatch, until
) -> None:
    heard: list[str] = []
    hear = Ownership._receive

    def note(self: Ownership, token: str, there: bool) -> None:
        heard.append(token)
        hear(self, token, there)

    monkeypatch.setattr(Ownership, "_receive", note)
    executor, flooder = await new_bus("executor"), await new_bus("camera")
    executor.serve(topics.TASK_COMMAND, obey)
    executor.writer(topics.JOINT_STATES)
    await executor.ready()
    seen: set[str] = set()
    (await new_bus("tool")).raw_watch_tokens(owns_key(executor.cell), seen.add)
    for number in range(FLOOD):
        flooder._declare_token(forged(number, cell=executor.cell))
    # Comes after all of these to who hears it.
    flooder._declare_token(forged(0, "joint_states", "executor", cell=executor.cell))
    await until(lambda: forged(0, "joint_states", "executor", cell=executor.cell) in heard)
    await until(lambda: len(seen) >= FLOOD)
    assert len([token for token in heard if "camera" in token]) == 0


class Flooded:
    """A camera whose key thousands of forged tokens claim, all of them later than it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.net = LocalNetwork()
        self.judged: list[Owner] = []
        judge = Ownership._resolve

        def note(owners: Ownership, other: Owner, now: float) -> None:
            self.judged.append(other)
            judge(owners, other, now)

        monkeypatch.setattr(Ownership, "_resolve", note)
        self.bus = self.net.bus("camera")
        self.bus.writer(topics.CAMERA_IMAGE)
        self.ran = asyncio.create_task(self.bus.run(self._run()))
        self._session = self.net.session()

    async def _run(self) -> None:
        await self.bus.ready()
        await asyncio.Event().wait()

    async def flood(self) -> None:
        await self.bus.ready_event.wait()
        for number in range(FLOOD):
            self._session.token(forged(number))
        for word in (*ODD, "*"):
            for process in ODD:
                self._session.token(owns_key("test", "camera/image_raw", word, "camera", f"x{process}"))
        self._session.token("test/owns/**")
        await self.look()

    async def look(self) -> None:
        """Have all that was there for long enough judged."""
        for _ in range(4):
            await asyncio.sleep(0)


async def test_few_of_those_who_claim_a_key_are_looked_at_and_told_of(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(ownership, "CONFLICT_SECONDS", 0.0)
    flooded = Flooded(monkeypatch)
    await flooded.flood()
    assert len(flooded.judged) <= 2 * MAX_OTHERS
    assert 0 < caplog.text.count("gives way") <= MAX_WARNINGS and not flooded.ran.done()
    flooded.ran.cancel()


async def test_other_that_was_there_first_is_met_amid_a_flood(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ownership, "CONFLICT_SECONDS", 0.0)
    flooded = Flooded(monkeypatch)
    await flooded.flood()
    flooded.net.session().token(owns_key("test", "camera/image_raw", "camera/image_raw", "camera", f"{7:016x}-first"))
    with pytest.raises(ConfigError, match=r"another camera \(process first\) .* was there first: this one ends"):
        await asyncio.wait_for(flooded.ran, 20)


async def test_lines_about_who_claims_a_key_go_on_after_a_while_and_say_how_many_there_were() -> None:
    net, lines = LocalNetwork(), []
    loop = asyncio.get_running_loop()
    owners = Ownership(net.session(), "test", "camera", loop=loop, warn=lines.append, lose=pytest.fail)
    owners.claim("camera/image_raw", "camera/image_raw")
    await owners.settle()
    others = [Owner.of(forged(number)) for number in range(2 * MAX_WARNINGS + 1)]
    for other in others[:-1]:
        owners._resolve(other, now=0.0)
    assert len(lines) == MAX_WARNINGS
    owners._resolve(others[-1], now=ownership.WARNING_SECONDS)
    assert lines[-1].endswith(f"; so did {MAX_WARNINGS} before") and len({*lines}) == MAX_WARNINGS + 1
