"""A plan of faults that fits a cell, with what carries it out."""

from __future__ import annotations

from collections.abc import Iterable

from common.application import all_topics, find_application
from common.chaos.agent import Chaos
from common.chaos.plan import CELL_SECONDS, faults, plan
from common.config import Cell
from common.hardware.loading import find_backend
from common.supervision.supervisor import Supervisor
from common.transport.bus import Bus
from common.transport.keys import ROUTER
from common.transport.ownership import Owner


def chaos_in(
    bus: Bus, cell: Cell, supervisor: Supervisor, keys: list[str], seed: int, per_minute: float, *, until_ended: bool
) -> Chaos:
    """Faults for the processes and keys of a cell that is up.

    Args:
        bus: of the supervisor.
        cell: the resolved cell.
        supervisor: knows the processes.
        keys: of messages that may be damaged.
        seed: of the plan.
        per_minute: faults per minute of wall time, on average.
        until_ended: the faults end while a run of the task has time left to finish; else they go on.
    """
    ours = [entry.name for entry in cell.services.values()]
    processes = [status.name for status in supervisor.statuses if status.name in (ROUTER, *ours)]
    grasps = find_application(cell.application).grasps and cell.task in ours
    objects = grasps and find_backend(cell.robot).simulated
    if until_ended:
        seconds = CELL_SECONDS / bus.clock.speed
        planned = iter(plan(seed, processes, keys, objects=objects, seconds=seconds, per_minute=per_minute))
    else:
        planned = faults(seed, processes, keys, objects=objects, per_minute=per_minute)

    def pids() -> dict[str, int]:
        return {status.name: status.pid for status in supervisor.statuses if status.pid is not None}

    return Chaos(bus, planned, pids, list(cell.world.containers.values()) if objects else None)


def keys_of(owners: Iterable[Owner], services: Iterable[str]) -> list[str]:
    """Keys that these services write or answer, but for their parameters; the platform's first."""
    owned = {owner.key for owner in owners if owner.service in set(services)}
    return [key for key in all_topics() if key in owned]
