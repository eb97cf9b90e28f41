"""The list of alarms with acknowledgement: faults, lost connections, and errors in the log."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import viser

from common.messages import LogLine
from common.time_source import wall_ns
from page.markup import Html, block, buttons, press, row, span, table, text
from page.status_text import plain

if TYPE_CHECKING:
    from page.console import ActionQueue

MAX_ALARMS = 100
MAX_LENGTH = 300  # characters


@dataclass(eq=False)
class Alarm:
    """One alarm: `count` times so far, last at `when` [s since the Unix epoch]."""

    message: str
    when: float
    count: int = 1
    active: bool = False
    acknowledged: bool = False


class Alarms:
    """All alarms, oldest first; the oldest are forgotten beyond `MAX_ALARMS`."""

    def __init__(self) -> None:
        """Start without alarms."""
        self.alarms: list[Alarm] = []

    @property
    def unacknowledged(self) -> int:
        """Number of alarms that no operator has acknowledged."""
        return sum(not alarm.acknowledged for alarm in self.alarms)

    def update(self, messages: Iterable[str]) -> None:
        """Set the active alarms: a new one is added, one that is over remains in the list."""
        current = {message[:MAX_LENGTH] for message in messages}
        for alarm in self.alarms:
            alarm.active = alarm.active and alarm.message in current
        for message in sorted(current - {alarm.message for alarm in self.alarms if alarm.active}):
            self._add(message).active = True

    def add_line(self, line: LogLine) -> None:
        """Add an error of a log line."""
        if line.level in ("error", "critical"):
            self._add(f"{line.service}: {line.message}"[:MAX_LENGTH])

    def acknowledge(self) -> None:
        """Mark all alarms as acknowledged."""
        for alarm in self.alarms:
            alarm.acknowledged = True

    def _add(self, message: str) -> Alarm:
        """Add an alarm; one that is repeated before it was acknowledged is counted."""
        now = wall_ns() * 1e-9
        known = next((each for each in self.alarms if each.message == message and not each.acknowledged), None)
        if known is None:
            known = Alarm(message, now, count=0)
        else:
            self.alarms.remove(known)
        known.when, known.count = now, known.count + 1
        self.alarms = [*self.alarms, known][-MAX_ALARMS:]
        return known


class AlarmPanel:
    """The list, newest first, and the button that acknowledges it."""

    def __init__(self, gui: viser.GuiApi, console: ActionQueue, alarms: Alarms) -> None:
        """Build the panel."""
        self._alarms = alarms
        console.on_press("alarms", self._acknowledge, "Acknowledge all alarms")
        self._html = Html(gui)

    def show(self) -> None:
        """Update the panel."""
        alarms = self._alarms
        rows = [row(text(time.strftime("%H:%M:%S", time.localtime(each.when))),
                    span(plain(each.message) + (f" ({each.count} times)" if each.count > 1 else ""),
                         "dim" if each.acknowledged else "bad"),
                    text("present" if each.active else "over")) for each in reversed(alarms.alarms)]
        button = press("Acknowledge", "alarms", "" if alarms.unacknowledged else "there is no new alarm")
        self._html.set(block(buttons(button, label="Alarms")
                             + (table((), rows, "log") if rows else span("No alarms", "dim")), "alarms",
                             alarms=len(rows)))

    def _acknowledge(self) -> None:
        self._alarms.acknowledge()
        self.show()
