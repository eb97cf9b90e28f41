"""What a session will start: the options of `run` and `up`, checked and resolved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from common.errors import ConfigError
from common.supervision.multi_host import HostOptions

if TYPE_CHECKING:
    from common.config import Cell
    from common.supervision.launch import Launch
    from page.address import PageAddress
    from recording.report.aggregator import RunAggregator


class Faults(NamedTuple):
    """Injected faults, as requested."""

    seed: int
    per_minute: float
    until_ended: bool  # stop in time for the run to finish; otherwise never


class SessionPlan:
    """Launch, cell, page, recorder and faults of a session; nothing is started."""

    def __init__(
        self, cell: str, overrides: Sequence[str] | None = None, *, world: str | None = None, seed: int | None = None,
        speed: float = 1.0, domain: str | None = None, connect: str | None = None, no_viewer: bool = False,
        summary: str | None = None, log_json: bool = False, host: HostOptions | None = None,
    ) -> None:
        """Check all options; nothing is started yet.

        Args:
            cell: name or path of its file.
            overrides: as for `--set`.
            world: another world, by name or path.
            seed: of all random numbers.
            speed: cell time per wall time.
            domain: of the router, as for `--domain`.
            connect: endpoint of another router, as for `--connect`.
            no_viewer: without the operator's page.
            summary: file for the figures of a run.
            log_json: write log lines as JSON.
            host: what runs on this host.

        Raises:
            ConfigError, UnknownName: one line naming the option, the value and the choices.
        """
        from common.supervision.launch import process_start_time

        self.began = process_start_time()
        resolved = resolve(
            cell, overrides, world=world, seed=seed, speed=speed, domain=domain, connect=connect, no_viewer=no_viewer,
            summary=summary, log_json=log_json, host=host or HostOptions())
        self.launch, self.cell, self.file = resolved.launch, resolved.cell, resolved.summary_file
        self.aggregator, self.on_all_hosts = resolved.aggregator, resolved.on_all_hosts
        self.summary = self.aggregator.summary
        self._page: PageAddress | None = None
        self._watchers: dict[str, list[str]] = {}  # commands of observing processes by name
        self._faults: Faults | None = None

    def serve_page(self, host: str | None, port: str | None) -> None:
        """Set where the operator's page listens, if the cell has one.

        Raises:
            ConfigError: the cell has no page, the port is in use, or host or port are not valid.
        """
        from page.address import plan_page

        self._page = page = plan_page(self.cell, host, port)
        if page is not None:
            overrides = (*self.launch.overrides, *page.overrides)
            self.launch = replace(self.launch, overrides=overrides, extra=page.environment)

    def record_to(self, file: str | None) -> None:
        """Record everything, from before the services are ready until after their end.

        Raises:
            ConfigError: the file cannot be a recording.
        """
        if file is None:
            return
        from common.supervision.launch import module_command
        from common.transport.credentials import RECORDER
        from recording.capture import CustomTopics
        from recording.formatting import require_new
        from security.preflight import require_recorder

        path = Path(file).absolute()
        require_new(path, "--record")
        require_recorder(self.launch, self.cell)
        router = ["--connect", self.launch.connect] if self.launch.connect else ["--domain", str(self.launch.domain)]
        self._watchers[RECORDER] = [
            *module_command("cli.main"), "record", "--cell", self.cell.name, "-o", str(path), *router, "--gate",
            "--own", str(CustomTopics.of(self.cell)),
        ]

    def inject_faults(self, seed: int, per_minute: float, *, until_ended: bool) -> None:
        """Inject faults once the cell is up: without end, or until a run has time left to finish."""
        self._faults = Faults(seed, per_minute, until_ended)

    def leave_out(self, name: str) -> None:
        """Do not start a service."""
        self.cell = without(self.cell, [name])

    def write_summary(self) -> None:
        """Write the figures of the run to its summary file, if there is one."""
        if self.file is not None:
            self.summary.write(self.file)

    @property
    def _simulated(self) -> bool:
        from common.hardware.backends import is_simulated

        return is_simulated(self.cell.robot)


@dataclass
class Resolved:
    """A launch, the part of the cell that runs on this host, the complete cell, and the aggregator of its figures."""

    launch: Launch
    cell: Cell
    on_all_hosts: Cell
    aggregator: RunAggregator
    summary_file: Path | None


def resolve(
    cell: str, overrides: Sequence[str] | None, *, world: str | None, seed: int | None, speed: float,
    domain: str | None, connect: str | None, no_viewer: bool, summary: str | None, log_json: bool, host: HostOptions,
) -> Resolved:
    """Check all options of a session; see `SessionPlan`.

    Raises:
        ConfigError, UnknownName: one line naming the option, the value and the choices.
    """
    from common.application import find_application
    from common.config import expanded, load_cell
    from common.supervision.launch import Launch, clock_at_speed, require_free_port, require_modules, router_location
    from common.transport.endpoint import endpoint_of
    from recording.report.aggregator import RunAggregator
    from security.page_tokens import VIEWER
    from security.preflight import require_secured, with_near
    from tools.check.cell import require_safe, require_valid_services

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
        loaded.name, find_application(loaded.application), robot=loaded.robot, seed=loaded.run.seed, arms=loaded.robots,
        speed=launch.clock.speed, containers=loaded.world.destinations, parameters=loaded.task_parameters)
    require_modules(loaded)
    require_safe(loaded)
    here = host.part_of(loaded)
    require_valid_services(here)
    if endpoint is None:
        require_free_port(endpoint_of(number))
    require_secured(launch, here)
    return Resolved(with_near(launch), here, loaded, aggregator, summary_file)


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
