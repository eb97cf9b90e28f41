"""A plan of faults that fits a cell, with what carries it out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from common.application import all_topics, find_application
from common.config import Cell
from common.hardware.loading import is_simulated
from common.supervision.supervisor import Supervisor
from common.topics import AnyTopic
from common.transport.bus import Bus
from common.transport.ownership import Owner
from common.transport.session import ROUTER
from lab.chaos.agent import Chaos
from lab.chaos.plan import CELL_SECONDS, faults, plan
from tools.check.cell import seen_from_home


def chaos_in(
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
