"""The panel that shows how every process is doing."""

from __future__ import annotations

from collections.abc import Iterable

import viser

from common.messages import ServiceCounters, SupervisorStatus
from common.supervision.rates import Rates
from common.viewer import words
from common.viewer.markup import block, row, span, table, text

HEAD = ("Service", "State", "PID ", "Restarts ", "Busiest topic", "Skipped ", "Lost ")
SKIPPED, LOST = "Skipped: a newer one came before it was read.", "Lost: refused, or one too many."
LEGEND = f"<div>{span(f'{SKIPPED} {LOST}', 'dim small')}</div>"


class HealthPanel:
    """A table of the services: state, process, rate of the busiest topic, lost and refused messages."""

    def __init__(self, gui: viser.GuiApi, services: Iterable[str]) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            services: of the cell, in start order.
        """
        self._services = list(services)
        self._rates = Rates()
        self._counters: dict[str, ServiceCounters] = {}
        self._html = gui.add_html("")

    def count(self, counters: ServiceCounters, now: float) -> None:
        """Take note of what a service counted until a wall time [s]."""
        self._rates.update(counters, now)
        self._counters[counters.service] = counters

    def show(self, supervisor: SupervisorStatus | None, alive: frozenset[str]) -> None:
        """Show all services as the supervisor sees them; without one, whether they are there."""
        if supervisor is not None:
            rows = [self._row(s.name, s.state, s.pid, s.restarts, s.message) for s in supervisor.services]
        else:
            rows = [self._row(name, "ready" if name in alive else "gone", None, 0, "") for name in self._services]
        content = block(table(HEAD, rows, "small") + LEGEND, "health")
        if content != self._html.content:
            self._html.content = content

    def _row(self, name: str, state: str, pid: int | None, restarts: int, message: str) -> str:
        word, kind = words.service_state(state, restarts)
        busiest = self._rates.busiest_of(name) if kind == "good" else None
        counted = self._counters.get(name)
        skipped = sum(counted.dropped.values()) if counted else 0
        lost = sum(counted.overflow.values()) + sum(counted.invalid.values()) if counted else 0
        return row(
            span(name, "tight"),
            f'{span(f"● {word}", kind)} {span(message, "dim") if message else ""}',
            text(pid if pid is not None else "–"),
            str(restarts),
            span(f"{busiest[0]} {busiest[1]:.0f} Hz", "tight") if busiest else span("–", "dim"),
            str(skipped),
            span(lost, "bad") if lost else "0",
            service=name, state=state, pid=pid or "", restarts=restarts,
        )
