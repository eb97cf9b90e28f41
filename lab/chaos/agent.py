"""Carries out a fault plan in a running cell, from the process of its supervisor."""

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
from common.hardware.backends import has_simulated_world
from common.messages import Message, WorldEdit
from common.supervision.supervisor import Supervisor
from common.time_source import monotonic
from common.topics import AnyTopic
from common.transport.codec import (
    DEFAULT_LIMIT,
    Attachment,
    checksum_of,
    decode,
    decode_attachment,
    encode_attachment,
    encoding_of,
)
from common.transport.ownership import Owner
from common.transport.session import ROUTER
from lab.chaos.plan import CELL_SECONDS, STATELESS_FORMS, Fault, Form, faults, plan
from lab.chaos.slip_gate import SlipGate
from tools.check.cell import seen_from_home

if TYPE_CHECKING:
    from common.transport.bus import Bus, Reader
    from common.transport.session import RawSample

GRASP_TIMEOUT = 4.0  # [s] that a fault of a process waits until the gripper holds an object
SLIP_TIMEOUT = 20.0  # [s] that a slip waits until the gripper holds an object
SAMPLE_SECONDS = 1.5  # within which a state is repeated
DROP_TIMEOUT = 1.0  # [s]
SPACING = 0.02  # [s] between bad messages

log = logging.getLogger("chaos")


@dataclass(frozen=True)
class Injected:
    """A fault that was carried out, `t` [s, wall time] after the start of the plan."""

    t: float
    what: str
    target: str


class Chaos:
    """Carries out faults one after the other; `injected` lists them."""

    def __init__(
        self, bus: Bus, plan: Iterable[Fault], pids: Callable[[], dict[str, int]], world: World | None,
        slip_timeout: float = SLIP_TIMEOUT, known: Mapping[str, AnyTopic] | None = None,
    ) -> None:
        """Declare readers and clients.

        Args:
            bus: of the cell.
            plan: faults in order of time.
            pids: returns the running processes by name.
            world: with fixed cameras, to let objects slip where they stay visible and reachable. None if the cell
                grasps no objects.
            slip_timeout: time to wait for an object that may slip [s, wall time].
            known: topics whose messages are damaged, by key in the cell; by default those of the project.
        """
        self.injected: list[Injected] = []
        self._bus, self._plan, self._pids = bus, plan, pids
        self._slip_timeout = slip_timeout
        self._known = all_topics() if known is None else known
        grasps = world is not None
        self._slip_gate = SlipGate(world) if world is not None else None
        self._gripper = bus.reader(topics.GRIPPER_STATE) if grasps else None
        self._objects = bus.reader(topics.SCENE_OBJECTS) if grasps else None
        self._edit = bus.client(topics.WORLD_EDIT) if grasps else None
        self._started_at = 0.0
        self._stopped: set[int] = set()

    async def run(self) -> None:
        """Carry out the plan; on cancellation, processes that are still stopped continue."""
        self._started_at = monotonic()
        try:
            async with asyncio.TaskGroup() as running:
                for fault in self._plan:
                    await asyncio.sleep(max(0.0, self._started_at + fault.at - monotonic()))
                    if fault.holding:
                        await _wait_for(self._gripper, self._is_holding, GRASP_TIMEOUT)
                    await self._inject(fault, running)
            if self._stopped:  # they stay so until a watchdog kills them, or this task is cancelled
                await asyncio.Event().wait()
        finally:
            for pid in self._stopped.intersection(self._pids().values()):
                _signal(pid, signal.SIGCONT)

    def as_dicts(self) -> list[dict[str, object]]:
        """Return the faults for the summary file."""
        return [asdict(one) for one in self.injected]

    async def _inject(self, fault: Fault, running: asyncio.TaskGroup) -> None:
        """Carry out a fault; what takes longer runs concurrently with the following faults."""
        if fault.kind == "drop":
            running.create_task(self._drop(fault))
        elif fault.kind in ("corrupt", "replay"):
            running.create_task(self._put_bad_messages(fault))
        elif (pid := self._pids().get(fault.target)) is None:
            log.info("no fault: %s does not run", fault.target)
        elif fault.kind in ("kill", "restart"):
            self._record(fault)
            _signal(pid, signal.SIGKILL if fault.kind == "kill" else signal.SIGTERM)
        else:
            self._record(fault)
            running.create_task(self._stop_and_continue(fault, pid))

    def _record(self, fault: Fault) -> None:
        now = round(monotonic() - self._started_at, 2)
        log.warning("CHAOS %.1f s: %s", now, fault)
        self.injected.append(Injected(now, fault.what, fault.target))

    async def _stop_and_continue(self, fault: Fault, pid: int) -> None:
        for _ in range(fault.count):
            self._stopped.add(pid)
            _signal(pid, signal.SIGSTOP)
            if not math.isfinite(fault.seconds):  # a watchdog is to kill it; it continues when this agent ends
                return
            await asyncio.sleep(fault.seconds)
            self._stopped.discard(pid)
            if self._pids().get(fault.target) != pid:  # a watchdog has killed it
                return
            _signal(pid, signal.SIGCONT)
            await asyncio.sleep(fault.seconds / 2)

    # --- objects --------------------------------------------------------------------------------------------------

    def _is_holding(self) -> bool:
        latest = self._gripper.latest if self._gripper else None
        return latest is not None and latest.holding

    def _may_slip(self) -> bool:
        return self._slip_gate is not None and self._slip_gate.may(self._objects.latest if self._objects else None)

    async def _drop(self, fault: Fault) -> None:
        rng = np.random.default_rng(fault.seed)
        if self._edit is None:
            return
        for wait in (float(rng.uniform(0, 0.3)), 0.0):
            if not await _wait_for(self._objects, self._may_slip, self._slip_timeout):
                log.info("no slip: the gripper holds no object that may slip")
                return
            await asyncio.sleep(wait)  # not always at the first opportunity
        try:
            await self._edit.call(WorldEdit(op="drop"), DROP_TIMEOUT)
        except RequestFailed as error:
            log.info("no slip: %s", error)
            return
        self._record(fault)

    # --- messages -------------------------------------------------------------------------------------------------

    async def _put_bad_messages(self, fault: Fault) -> None:
        """Put bad messages under a key, as if from its writer or from a stranger."""
        topic: Any = self._known[fault.target]
        key, encoding = f"{self._bus.cell}/{topic.key}", encoding_of(topic.message)
        rng = np.random.default_rng(fault.seed)
        if topic.kind == "request":
            self._record(fault)
            for _ in range(fault.count):
                payload = invalid_payload(topic.message, _stateless(fault, rng), rng)
                await self._bus.raw_get(key, 0.5, payload=payload, encoding=encoding)
            return
        real = None if fault.form in STATELESS_FORMS else await self._sample(key)
        if fault.kind == "replay":
            if real is None:
                log.info("no replay: nothing is published on %s", fault.target)
                return
            await asyncio.sleep(fault.seconds)
        self._record(fault)
        publisher = self._bus.raw_publisher(key, encoding, reliable=topic.kind != "stream")
        try:
            for _ in range(fault.count):
                if real is not None and fault.kind == "replay":
                    publisher.put(real.payload, real.attachment or b"")
                else:
                    publisher.put(*self._damage(key, topic.message, real, fault, rng))
                await asyncio.sleep(SPACING)
        finally:
            publisher.undeclare()

    def _damage(
        self, key: str, model: type[Message], real: RawSample | None, fault: Fault, rng: np.random.Generator
    ) -> tuple[bytes, bytes]:
        """Return a damaged payload with its attachment: of the real writer, or of a stranger."""
        attachment = decode_attachment(real.attachment) if real else None
        if real is None or attachment is None:
            payload = invalid_payload(model, _stateless(fault, rng), rng)
            own = Attachment("chaos", int(rng.integers(2**31)), checksum=checksum_of(key, payload))
            return payload, encode_attachment(own) if rng.random() < 0.5 else b""
        return next_damaged(real, attachment, fault.form, rng)

    async def _sample(self, key: str) -> RawSample | None:
        """Return a real message of a key; None if nothing is published there."""
        reader: Any = self._bus.raw_reader(key)
        try:
            async with asyncio.timeout(SAMPLE_SECONDS):
                sample: RawSample = await anext(reader)
                return sample
        except TimeoutError:
            return None
        finally:
            await reader.aclose()


async def _wait_for(reader: Reader[Any] | None, condition: Callable[[], bool], seconds: float) -> bool:
    """Return whether the condition held in time; it is evaluated after each message."""
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


# --- damaged payloads -------------------------------------------------------------------------------------------------


def _stateless(fault: Fault, rng: np.random.Generator) -> Any:
    """Return the form of the damage if there is no real message to damage."""
    return fault.form if fault.form in STATELESS_FORMS else STATELESS_FORMS[int(rng.integers(2))]


def next_damaged(
    real: RawSample, attachment: Attachment, form: Form, rng: np.random.Generator
) -> tuple[bytes, bytes]:
    """Return payload and attachment of a writer's next message as if damaged on its way.

    It has the next sequence number: with a higher one readers would drop the real messages that follow.
    """
    following = attachment._replace(sequence=attachment.sequence + 1, checksum=checksum_of(real.key, real.payload))
    return damaged(real.payload, form, rng), encode_attachment(following)


def damaged(payload: bytes, form: Form, rng: np.random.Generator) -> bytes:
    """Return a payload damaged in a form; only `truncated` and `flipped` use the given one.

    Args:
        payload: a real one, or empty.
        form: of the damage.
        rng: decides where the damage is.
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


def invalid_payload(model: type[Message], form: Form, rng: np.random.Generator) -> bytes:
    """Return a damaged payload that no reader accepts as a message of the model.

    Damaged bytes may be valid by chance: an empty map, for example, is a valid stop request.
    """
    while True:
        payload = damaged(b"", form, rng)
        try:
            decode(model, payload)
        except DecodeError:
            return payload


# --- chaos for a cell -------------------------------------------------------------------------------------------------


def create_chaos(
    bus: Bus, cell: Cell, supervisor: Supervisor, known: Mapping[str, AnyTopic], seed: int, per_minute: float, *,
    until_ended: bool,
) -> Chaos:
    """Return faults for the processes and keys of a running cell.

    Args:
        bus: of the supervisor.
        cell: resolved.
        supervisor: provides the processes.
        known: topics whose messages may be damaged, by key.
        seed: of the plan.
        per_minute: mean faults per minute of wall time.
        until_ended: whether faults end early enough for the task to finish; else they never end.
    """
    services = [entry.name for entry in cell.services.values()]
    processes = [status.name for status in supervisor.statuses if status.name in (ROUTER, *services)]
    objects = find_application(cell.application).grasps and cell.task in services and has_simulated_world(cell.robot)
    keys = list(known)
    if until_ended:
        seconds = CELL_SECONDS / bus.clock.speed
        planned = iter(plan(seed, processes, keys, objects=objects, seconds=seconds, per_minute=per_minute))
    else:
        planned = faults(seed, processes, keys, objects=objects, per_minute=per_minute)

    def pids() -> dict[str, int]:
        return {status.name: status.pid for status in supervisor.statuses if status.pid is not None}

    world = seen_from_home(cell).world if objects else None  # cameras on the arm are fixed at the home pose
    return Chaos(bus, planned, pids, world, known=known)


def keys_of(owners: Iterable[Owner], services: Iterable[str]) -> dict[str, AnyTopic]:
    """Return topics that services write or serve by key in the cell, parameters excluded, in the order of the topics.

    A remapped key has the topic of the service's own key.
    """
    owned = sorted({(owner.own, owner.key) for owner in owners if owner.service in set(services)})
    return {key: replace(topic, key=key) for word, topic in all_topics().items() for own, key in owned if own == word}
