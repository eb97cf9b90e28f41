"""A flood of liveliness tokens, also malformed ones, costs a bounded time of each event loop."""

import asyncio

import pytest

from common import topics
from common.errors import ConfigError
from common.transport import ownership
from common.transport.local import LocalNetwork, LocalSession
from common.transport.ownership import MAX_OTHERS, MAX_WARNINGS, Owner, Ownership
from common.transport.session import alive_key, owns_key
from common.transport.tokens import MAX_NAMES, MAX_PER_TURN, TokenWatch
from tests.common.transport.conftest import TIMEOUT, until

KEY = topics.CAMERA_IMAGE.key
FLOOD = 1500  # enough to exceed all limits
LATE = 2**63  # [ns] later than all real ones
UNUSUAL = ("0", "-", "zz", "-1--1", "|", "%s", "[bold]", "\x1b[31m", "\u202e", "a" * 1000)


def forged(number: int, key: str = KEY, service: str = "camera", *, cell: str = "test") -> str:
    """Return a token that a camera's certificate permits, with a freely chosen own key and process."""
    return owns_key(cell, key, f"k{number}", service, f"{LATE + number:016x}-{number:08x}")


class Watch:
    """The changes that a watch of ready services reports, and the most of them in one turn of the loop."""

    def __init__(self, session: LocalSession) -> None:
        self.changes: list[tuple[str, bool]] = []
        self.most_at_once = 0
        self._at_once = 0
        self.watch = TokenWatch(session, alive_key("test"), asyncio.get_running_loop())
        self.watch.on_change(self._note)

    def _note(self, name: str, there: bool) -> None:
        self.changes.append((name, there))
        self._at_once += 1
        if self._at_once == 1:
            asyncio.get_running_loop().call_soon(self._turn)

    def _turn(self) -> None:
        self.most_at_once, self._at_once = max(self.most_at_once, self._at_once), 0

    async def settled(self) -> None:
        """Return when all earlier changes have been reported."""
        for _ in range(2 + MAX_NAMES // MAX_PER_TURN):
            await asyncio.sleep(0)


async def test_watch_limits_names_per_turn_and_in_all(caplog) -> None:
    net = LocalNetwork()
    observed, flooder = Watch(net.session()), net.session()
    for number in range(FLOOD):
        flooder.token(alive_key("test", f"n{number}"))
    await observed.settled()
    assert 0 < observed.most_at_once <= MAX_PER_TURN
    assert len(observed.changes) == len(observed.watch.names) == MAX_NAMES
    assert observed.watch.left_out == FLOOD - MAX_NAMES and caplog.text.count("further ones are left out") == 1
    flooder.close()
    await observed.settled()
    token = net.session().token(alive_key("test", "camera"))
    await observed.settled()
    assert observed.watch.names == {"camera"}
    token.undeclare()
    await observed.settled()
    assert not observed.watch.names


@pytest.mark.parametrize("extra", [0, 1])
async def test_name_that_appears_and_vanishes_repeatedly_is_reported_once(extra: int) -> None:
    net = LocalNetwork()
    observed, flooder = Watch(net.session()), net.session()
    stays = net.session().token(alive_key("test", "task"))
    await observed.settled()
    stays.undeclare()
    net.session().token(alive_key("test", "task"))
    for _ in range(300):
        flooder.token(alive_key("test", "camera")).undeclare()
    if extra:
        flooder.token(alive_key("test", "camera"))
    await observed.settled()
    assert observed.changes[:3] == [("task", True), ("task", False), ("task", True)]  # it restarted
    assert observed.changes[3:] == ([("camera", True)] if extra else [("camera", True), ("camera", False)])
    assert observed.watch.names == {"task", *["camera"] * extra}


async def test_process_receives_only_tokens_of_its_own_keys(new_bus, monkeypatch) -> None:
    received: list[str] = []
    receive = Ownership._receive

    def note(self: Ownership, token: str, there: bool) -> None:
        received.append(token)
        receive(self, token, there)

    monkeypatch.setattr(Ownership, "_receive", note)
    executor, flooder = await new_bus("executor"), await new_bus("camera")
    executor.writer(topics.JOINT_STATES)
    await executor.ready()
    seen: set[str] = set()
    (await new_bus("tool")).raw_watch_tokens(owns_key(executor.cell), seen.add)
    last = forged(0, "joint_states", "executor", cell=executor.cell)
    for token in (*(forged(number, cell=executor.cell) for number in range(FLOOD)), last):
        flooder._declare_token(token)
    await until(lambda: last in received and len(seen) >= FLOOD)
    assert not [token for token in received if "camera" in token]


async def test_few_claimants_are_reported_and_an_earlier_owner_is_found_among_them(monkeypatch, caplog) -> None:
    net, resolved, resolve = LocalNetwork(), [], Ownership._resolve

    def note(owners: Ownership, other: Owner, now: float) -> None:
        resolved.append(other)
        resolve(owners, other, now)

    async def run() -> None:
        await bus.ready()
        await asyncio.Event().wait()

    monkeypatch.setattr(Ownership, "_resolve", note)
    monkeypatch.setattr(ownership, "CONFLICT_SECONDS", 0.0)
    bus, flooder = net.bus("camera"), net.session()
    bus.writer(topics.CAMERA_IMAGE)
    running = asyncio.create_task(bus.run(run()))
    await bus.ready_event.wait()
    malformed = [owns_key("test", KEY, own_key, "camera", f"x{process}")
                 for own_key in (*UNUSUAL, "*") for process in UNUSUAL]
    for token in (*(forged(number) for number in range(FLOOD)), *malformed, "test/owns/**"):
        flooder.token(token)
    for _ in range(4):  # until all owners that lasted long enough have been resolved
        await asyncio.sleep(0)
    assert 0 < len(resolved) <= 2 * MAX_OTHERS
    assert 0 < caplog.text.count("gives way") <= MAX_WARNINGS and not running.done()
    net.session().token(owns_key("test", KEY, KEY, "camera", f"{7:016x}-first"))
    with pytest.raises(ConfigError, match=r"another camera \(process first\) .* was there first: this one ends"):
        await asyncio.wait_for(running, TIMEOUT)


async def test_claim_warnings_resume_later_with_the_number_of_omitted_ones() -> None:
    net, lines = LocalNetwork(), []
    loop = asyncio.get_running_loop()
    owners = Ownership(net.session(), "test", "camera", loop=loop, warn=lines.append, lose=pytest.fail)
    owners.claim(KEY, KEY)
    await owners.settle()
    others = [Owner.of(forged(number)) for number in range(2 * MAX_WARNINGS + 1)]
    for other in others[:-1]:
        owners._resolve(other, now=0.0)
    assert len(lines) == MAX_WARNINGS
    owners._resolve(others[-1], now=ownership.WARNING_SECONDS)
    assert lines[-1].endswith(f"; so did {MAX_WARNINGS} before") and len({*lines}) == MAX_WARNINGS + 1
