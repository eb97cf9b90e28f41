"""Carries a plan of faults out in a cell that is up, from the process of its supervisor."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import signal
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import msgpack
import numpy as np

from common import topics
from common.application import all_topics, find_application
from common.config import Cell, World
from common.errors import DecodeError, RequestFailed
from common.hardware.loading import is_simulated
from common.messages import Message, WorldEdit
from common.sources import monotonic
from common.supervision.supervisor import Supervisor
from common.topics import AnyTopic
from common.transport.bus import Bus
from common.transport.codec import (
    DEFAULT_LIMIT,
    Attachment,
    checksum_of,
    decode,
    decode_attachment,
    encode_attachment,
    encoding_of,
)
from common.transport.keys import ROUTER
from common.transport.ownership import Owner
from lab.chaos.plan import CELL_SECONDS, STATELESS_FORMS, Fault, Form, SlipGate, faults, plan
from tools.check.cell import seen_from_home

if TYPE_CHECKING:
    from common.transport.bus import Bus, Reader
    from common.transport.session import RawSample


PATIENCE = 4.0  # [s] that a fault of a process waits for something in the hand
SLIP_PATIENCE = 20.0  # [s] that an object has to be taken before it slips
SAMPLE_SECONDS = 1.5  # within which a state is repeated
DROP_TIMEOUT = 1.0  # [s]
SPACING = 0.02  # [s] between bad messages in a row

log = logging.getLogger("chaos")


@dataclass(frozen=True)
class Happened:
    """A fault that was carried out, `t` [s, wall time] after the cell was up."""

    t: float
    what: str
    target: str


class Chaos:
    """Faults, carried out one after the other; `happened` lists them."""

    def __init__(
        self, bus: Bus, plan: Iterable[Fault], pids: Callable[[], dict[str, int]],
        world: World | None, patience: float = SLIP_PATIENCE,
        known: Mapping[str, AnyTopic] | None = None,
    ) -> None:
        """Declare what is listened to.

        Args:
            bus: of the cell.
            plan: faults in order of time.
            pids: the processes that run now, by name.
            world: with its cameras fixed; objects are let slip where they can be seen and taken again. None where no
                object is taken.
            patience: that there has to be something in the hand before it slips [s, wall time].
            known: topics whose messages are damaged, by key of the cell; else those that come with the project.
        """
        self.happened: list[Happened] = []
        self._bus, self._plan, self._pids = bus, plan, pids
        self._patience = patience
        self._known = all_topics() if known is None else known
        taken = world is not None
        self._slipping = SlipGate(world) if world is not None else None
        self._gripper = bus.reader(topics.GRIPPER_STATE) if taken else None
        self._objects = bus.reader(topics.SCENE_OBJECTS) if taken else None
        self._edit = bus.client(topics.WORLD_EDIT) if taken else None
        self._began = 0.0
        self._stopped: set[int] = set()

    async def run(self) -> None:
        """Carry the plan out; what is stopped and was not noticed goes on when this is cancelled."""
        self._began = monotonic()
        try:
            async with asyncio.TaskGroup() as lasting:
                for fault in self._plan:
                    await asyncio.sleep(max(0.0, self._began + fault.at - monotonic()))
                    if fault.holding:
                        await _until(self._gripper, self._is_holding, PATIENCE)
                    await self._begin(fault, lasting)
            if self._stopped:  # and stays so until somebody else ends it, or us
                await asyncio.Event().wait()
        finally:
            for pid in self._stopped.intersection(self._pids().values()):
                _signal(pid, signal.SIGCONT)

    def as_dicts(self) -> list[dict[str, object]]:
        """What happened, for the summary file."""
        return [asdict(one) for one in self.happened]

    async def _begin(self, fault: Fault, lasting: asyncio.TaskGroup) -> None:
        """Carry out a fault; one that lasts goes on beside those that follow."""
        if fault.kind == "drop":
            lasting.create_task(self._drop(fault))  # others need not wait until something is in the hand
        elif fault.kind in ("corrupt", "replay"):
            lasting.create_task(self._disturb(fault))
        elif (pid := self._pids().get(fault.target)) is None:
            log.info("%s is not there to be disturbed", fault.target)
        elif fault.kind in ("kill", "restart"):
            self._note(fault)
            _signal(pid, signal.SIGKILL if fault.kind == "kill" else signal.SIGTERM)
        else:
            self._note(fault)
            lasting.create_task(self._stop_and_go(fault, pid))

    def _note(self, fault: Fault) -> None:
        now = round(monotonic() - self._began, 2)  # told and kept alike
        log.warning("CHAOS %.1f s: %s", now, fault)
        self.happened.append(Happened(now, fault.what, fault.target))

    async def _stop_and_go(self, fault: Fault, pid: int) -> None:
        for _ in range(fault.count):
            self._stopped.add(pid)
            _signal(pid, signal.SIGSTOP)
            if not math.isfinite(fault.seconds):  # it is for a watchdog to end it; at our end it goes on
                return
            await asyncio.sleep(fault.seconds)
            self._stopped.discard(pid)
            if self._pids().get(fault.target) != pid:  # somebody has lost patience with it
                return
            _signal(pid, signal.SIGCONT)
            await asyncio.sleep(fault.seconds / 2)

    # --- objects --------------------------------------------------------------------------------------------------

    def _is_holding(self) -> bool:
        latest = self._gripper.latest if self._gripper else None
        return latest is not None and latest.holding

    def _may_slip(self) -> bool:
        return self._slipping is not None and self._slipping.may(self._objects.latest if self._objects else None)

    async def _drop(self, fault: Fault) -> None:
        rng = np.random.default_rng(fault.seed)
        if self._edit is None:
            return
        for wait in (float(rng.uniform(0, 0.3)), 0.0):
            if not await _until(self._objects, self._may_slip, self._patience):
                log.info("there is nothing in the hand to be let slip")
                return
            await asyncio.sleep(wait)  # not always as soon as it may
        try:
            await self._edit.call(WorldEdit(op="drop"), DROP_TIMEOUT)
        except RequestFailed as error:
            log.info("nothing slips: %s", error)
            return
        self._note(fault)

    # --- messages -------------------------------------------------------------------------------------------------

    async def _disturb(self, fault: Fault) -> None:
        """Put bad messages under a key, as if they came from who writes it, or from nobody."""
        topic: Any = self._known[fault.target]
        key, encoding = f"{self._bus.cell}/{topic.key}", encoding_of(topic.message)
        rng = np.random.default_rng(fault.seed)
        if topic.kind == "request":
            self._note(fault)
            for _ in range(fault.count):
                payload = nonsense(topic.message, _stateless(fault, rng), rng)
                await self._bus.raw_get(key, 0.5, payload=payload, encoding=encoding)
            return
        real = None if fault.form in STATELESS_FORMS else await self._sample(key)
        if fault.kind == "replay":
            if real is None:
                log.info("%s is silent: nothing to repeat", fault.target)
                return
            await asyncio.sleep(fault.seconds)
        self._note(fault)
        publisher = self._bus.raw_publisher(key, encoding, reliable=topic.kind != "stream")
        try:
            for _ in range(fault.count):
                if real is not None and fault.kind == "replay":
                    publisher.put(real.payload, real.attachment or b"")
                else:
                    publisher.put(*self._damaged(key, topic.message, real, fault, rng))
                await asyncio.sleep(SPACING)
        finally:
            publisher.undeclare()

    def _damaged(
        self, key: str, model: type[Message], real: RawSample | None, fault: Fault, rng: np.random.Generator
    ) -> tuple[bytes, bytes]:
        """A damaged payload and what rides beside it: damaged on its way, or put by a stranger."""
        attachment = decode_attachment(real.attachment) if real else None
        if real is None or attachment is None:
            payload = nonsense(model, _stateless(fault, rng), rng)
            own = Attachment("chaos", int(rng.integers(2**31)), checksum=checksum_of(key, payload))
            return payload, encode_attachment(own) if rng.random() < 0.5 else b""
        return next_damaged(real, attachment, fault.form, rng)

    async def _sample(self, key: str) -> RawSample | None:
        """A real message of a key; None when nothing is said there."""
        reader: Any = self._bus.raw_reader(key)
        try:
            async with asyncio.timeout(SAMPLE_SECONDS):
                sample: RawSample = await anext(reader)
                return sample
        except TimeoutError:
            return None
        finally:
            await reader.aclose()


def _stateless(fault: Fault, rng: np.random.Generator) -> Any:
    """The form of the damage where there is no real message to start from."""
    return fault.form if fault.form in STATELESS_FORMS else STATELESS_FORMS[int(rng.integers(2))]


async def _until(reader: Reader[Any] | None, condition: Callable[[], bool], seconds: float) -> bool:
    """Whether the condition came to hold in time, looked at whenever something is read."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while not condition():
                if reader is None:
                    return False
                await reader.next()
            return True
    return False


def _signal(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def next_damaged(
    real: RawSample, attachment: Attachment, form: Form, rng: np.random.Generator
) -> tuple[bytes, bytes]:
    """The next message of the writer of one that was heard, payload and attachment, had it been damaged on the way.

    It has the number that the next message has: one farther on would have readers take for old what comes after it.
    """
    following = attachment._replace(sequence=attachment.sequence + 1, checksum=checksum_of(real.key, real.payload))
    return damaged(real.payload, form, rng), encode_attachment(following)


def damaged(payload: bytes, form: Form, rng: np.random.Generator) -> bytes:
    """A payload in a damaged form; `truncated` and `flipped` start from the one that is given.

    Args:
        payload: a real one, if there is any.
        form: what is wrong with it.
        rng: where the damage is.
    """
    if form == "huge":
        return bytes(DEFAULT_LIMIT + 1)
    if form == "wrong type":
        choices: list[object] = [None, 7, "word", [1, 2, 3], {"header": "never"}, {}, {"poses": [{"position": "here"}]}]
        packed: bytes = msgpack.packb(choices[int(rng.integers(len(choices)))])
        return packed
    if form == "noise" or not payload:
        return rng.bytes(int(rng.integers(1, 2000)))
    if form == "truncated":
        return payload[: int(rng.integers(len(payload)))]
    flipped = bytearray(payload)
    for _ in range(int(rng.integers(1, 9))):
        flipped[int(rng.integers(len(flipped)))] ^= 1 << int(rng.integers(8))
    return bytes(flipped)


def nonsense(model: type[Message], form: Form, rng: np.random.Generator) -> bytes:
    """Bytes in a form that needs no real payload, and no message of the model: an empty map is a valid request to stop.

    Args:
        model: what should be there.
        form: huge, wrong type or noise.
        rng: makes them up.
    """
    while True:
        payload = damaged(b"", form, rng)
        try:
            decode(model, payload)
        except DecodeError:
            return payload


def create_chaos(
    bus: Bus, cell: Cell, supervisor: Supervisor, known: Mapping[str, AnyTopic], seed: int, per_minute: float, *,
    until_ended: bool,
) -> Chaos:
    """Faults for the processes and keys of a cell that is up.

    Args:
        bus: of the supervisor.
        cell: the resolved cell.
        supervisor: knows the processes.
        known: topics whose messages may be damaged, by key.
        seed: of the plan.
        per_minute: faults per minute of wall time, on average.
        until_ended: the faults end while a run of the task has time left to finish; else they go on.
    """
    ours = [entry.name for entry in cell.services.values()]
    processes = [status.name for status in supervisor.statuses if status.name in (ROUTER, *ours)]
    grasps = find_application(cell.application).grasps and cell.task in ours
    keys = list(known)
    objects = grasps and is_simulated(cell.robot)
    if until_ended:
        seconds = CELL_SECONDS / bus.clock.speed
        planned = iter(plan(seed, processes, keys, objects=objects, seconds=seconds, per_minute=per_minute))
    else:
        planned = faults(seed, processes, keys, objects=objects, per_minute=per_minute)

    def pids() -> dict[str, int]:
        return {status.name: status.pid for status in supervisor.statuses if status.pid is not None}

    world = seen_from_home(cell).world if objects else None  # a camera on the hand looks from there
    return Chaos(bus, planned, pids, world, known=known)


def keys_of(owners: Iterable[Owner], services: Iterable[str]) -> dict[str, AnyTopic]:
    """What these services write or answer by its key in the cell, but for their parameters, in the order of the topics.

    Of a key that a service has under another name it is known what it carries by the service's own word for it.
    """
    owned = sorted({(owner.own, owner.key) for owner in owners if owner.service in set(services)})
    return {key: replace(topic, key=key) for word, topic in all_topics().items() for own, key in owned if own == word}
