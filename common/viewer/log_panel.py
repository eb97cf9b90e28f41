"""The panel with the newest log lines of all services."""

from __future__ import annotations

import time
from collections import deque

import viser

from common.messages import LogLine
from common.viewer.desk import Desk
from common.viewer.layout import LogLevel
from common.viewer.markup import block, row, span, table, text

LEVELS: tuple[LogLevel, ...] = ("debug", "info", "warning", "error")
_RANK = {"debug": 0, "info": 1, "warning": 2, "error": 3, "critical": 4}
_KIND = {"debug": "dim", "info": "", "warning": "busy", "error": "bad", "critical": "bad"}
KEPT = 2000  # lines
SHOWN = 200  # lines, the newest first
LONGEST = 500  # characters of a line
LATEST = 4e9  # [s] since the Unix epoch: a stamp may say anything


class LogPanel:
    """Keeps lines and shows those of a level and above."""

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
        desk.on_change(chosen, self._set_level)
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
