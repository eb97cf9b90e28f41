"""The panels that show how every process is doing, and what it says."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable

import viser

from common.client.statistics import Rates
from common.messages import LogLine, ServiceCounters, SupervisorStatus
from page import words
from page.console import Desk
from page.layout import LogLevel
from page.markup import block, row, span, table, text

# What a newer one replaced before it was read is not counted here: with streams that is how it is meant.
HEAD = ("Service", "State", "PID ", "Restarts ", "Busiest topic", "Lost ")
LEGEND = f"<div>{span('Lost: messages that were refused, or one too many.', 'dim small')}</div>"

LEVELS: tuple[LogLevel, ...] = ("debug", "info", "warning", "error")
_RANK = {"debug": 0, "info": 1, "warning": 2, "error": 3, "critical": 4}
_KIND = {"debug": "dim", "info": "", "warning": "busy", "error": "bad", "critical": "bad"}
KEPT = 2000  # lines
SHOWN = 200  # lines, the newest first
LONGEST = 500  # characters of a line
LATEST = 4e9  # [s] since the Unix epoch: a stamp may say anything


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
        self._html = gui.add_html("")

    def count(self, counters: ServiceCounters, now: float) -> None:
        """Take note of what a service counted until a wall time [s]."""
        self._rates.update(counters, now)

    def show(self, supervisor: SupervisorStatus | None, alive: frozenset[str]) -> None:
        """Show all services as the supervisor sees them; without one, whether they are there."""
        if supervisor is not None:
            rows = [self._row(s.name, s.state, s.pid, s.restarts, s.message) for s in supervisor.services]
        else:
            rows = [self._row(name, "ready" if name in alive else "gone", None, 0, "") for name in self._services]
        notices = "".join(
            f"<div>{span(each.message, 'bad' if each.urgent else 'busy')}</div>"
            for each in (supervisor.notices if supervisor is not None else ()))
        content = block(notices + table(HEAD, rows, "small") + LEGEND, "health")
        if content != self._html.content:
            self._html.content = content

    def _row(self, name: str, state: str, pid: int | None, restarts: int, message: str) -> str:
        word, kind = words.service_state(state, restarts)
        busiest = self._rates.busiest_of(name) if kind == "good" else None
        counted = self._rates.counted(name)
        lost = sum(counted.overflow.values()) + sum(counted.invalid.values()) if counted else 0
        return row(
            span(name, "tight"),
            f'{span(f"● {word}", kind)} {span(message, "dim") if message else ""}',
            text(pid if pid is not None else "–"),
            str(restarts),
            span(f"{busiest[0]} {busiest[1]:.0f} Hz", "tight") if busiest else span("–", "dim"),
            span(lost, "bad") if lost else "0",
            service=name, state=state, pid=pid or "", restarts=restarts,
        )


class LogPanel:
    """The newest log lines of all services: keeps them and shows those of a level and above."""

    def __init__(self, gui: viser.GuiApi, desk: Desk, level: LogLevel) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            desk: takes a change of the level.
            level: at the start.
        """
        self.level = level
        self._lines: deque[tuple[int, str]] = deque(maxlen=KEPT)
        self._changed = True
        chosen = gui.add_dropdown("Show", LEVELS, initial_value=level, hint="lines of this level and above")
        desk.on_change(chosen, self._set_level, "look")
        self._html = gui.add_html("")

    def add(self, line: LogLine) -> None:
        """Take in a line."""
        stamp = min(line.header.stamp * 1e-9, LATEST)
        when = time.strftime("%H:%M:%S", time.localtime(stamp)) if stamp else ""
        message = line.message if len(line.message) <= LONGEST else line.message[:LONGEST] + " …"
        shown = row(text(when), text(line.service), span(message, _KIND[line.level]), level=line.level)
        self._lines.append((_RANK[line.level], shown))
        self._changed = True

    def show(self) -> None:
        """Bring what is shown up to date."""
        if not self._changed:
            return
        self._changed = False
        rank = _RANK[self.level]
        lines = [shown for level, shown in reversed(self._lines) if level >= rank][:SHOWN]
        self._html.content = block(
            table((), lines, "log") if lines else span("Nothing of this level yet", "dim"), "log", lines=len(lines))

    def _set_level(self, level: LogLevel) -> None:
        self.level = level
        self._changed = True
        self.show()
