"""The options of `run` and `up`, checked and resolved before anything is started."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from common.errors import ConfigError
from common.supervision.multi_host import HostOptions

if TYPE_CHECKING:
    from common.config import Cell
    from common.supervision.launch import Launch
    from recording.report.aggregator import RunAggregator


@dataclass
class Resolved:
    """A launch, the part of the cell that runs on this host, and the aggregator of its figures."""

    launch: Launch
    cell: Cell
    aggregator: RunAggregator
    summary_file: Path | None


def resolve(
    cell: str, overrides: Sequence[str] | None, *, world: str | None, seed: int | None, speed: float,
    domain: str | None, connect: str | None, no_viewer: bool, summary: str | None, log_json: bool, host: HostOptions,
) -> Resolved:
    """Check all options of a session; see `CellSession`.

    Raises:
        ConfigError, UnknownName: one line naming the option, the value and the choices.
    """
    from common.application import find_application
    from common.config import expanded, load_cell
    from common.supervision.launch import Launch, clock_at_speed, require_free_port, require_modules, router_location
    from common.transport.endpoint import endpoint_of
    from recording.report.aggregator import RunAggregator
    from security.page_tokens import VIEWER
    from security.validation import require_secured, with_near
    from tools.check.cell import require_safe

    summary_file = _summary_file(summary)
    number, endpoint = router_location(domain, connect)
    launch = host.linked(Launch(
        cell=cell, overrides=tuple(expanded(overrides or ())), world=world, seed=seed, domain=number,
        connect=endpoint, log_json=log_json, clock=clock_at_speed(speed, host.epoch(speed)),
    ))
    loaded = load_cell(cell, launch.overrides, world=world, seed=launch.seed)
    if no_viewer:
        loaded = without(loaded, [entry.name for entry in loaded.services.values() if entry.kind == VIEWER])
    aggregator = RunAggregator(
        loaded.name, find_application(loaded.application), robot=loaded.robot, seed=loaded.run.seed,
        speed=launch.clock.speed, containers=list(loaded.world.containers))
    require_modules(loaded)
    require_safe(loaded)
    if endpoint is None:
        require_free_port(endpoint_of(number))
    here = host.part_of(loaded)
    require_secured(launch, here)
    return Resolved(with_near(launch), here, aggregator, summary_file)


def _summary_file(summary: str | None) -> Path | None:
    if not summary:
        return None
    file = Path(summary)
    if not file.absolute().parent.is_dir():
        raise ConfigError("--summary", summary, "is in a folder that does not exist")
    if file.is_dir():
        raise ConfigError("--summary", summary, "is a folder")
    return file


def without(cell: Cell, services: Sequence[str]) -> Cell:
    """Return the cell without some services, given by name."""
    rest = {key: entry for key, entry in cell.services.items() if entry.name not in services}
    return cell.model_copy(update={"services": rest})
