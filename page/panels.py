"""The panels that need neither the scene nor topics on demand, and the tabs."""

from __future__ import annotations

from collections.abc import Iterable

import viser

from page.alarms import AlarmPanel, Alarms
from page.console import Console
from page.diagnostics import HealthPanel, LogPanel
from page.layout import TABS, Layout, Tab
from page.main_panel import ControllerPanel, TaskPanel
from page.status_text import TaskText
from page.tuning import TuningPanel


class Panels:
    """The main panel, Health, Log with the alarms, Tuning; and all tabs.

    Attributes:
        task, controller, health, alarm_panel, log, tuning: the panels.
        alarms: the list of alarms.
        tabs: container of each tab; one that the layout leaves out is invisible.
    """

    def __init__(
        self, server: viser.ViserServer, console: Console, layout: Layout, cell: str, text: TaskText
    ) -> None:
        """Build the main panel and empty tabs.

        Args:
            server: that serves the page.
            console: sends requests to the cell.
            layout: initial layout.
            cell: its name.
            text: texts for the task.
        """
        self._gui, self._console, self._layout = server.gui, console, layout
        gui = server.gui
        gui.configure_theme(dark_mode=layout.dark, show_logo=False, show_share_button=False)
        gui.set_panel_label(f"zencell · {cell}")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(layout.panel_width)
        self.task = TaskPanel(gui, console, text)
        self.controller = ControllerPanel(gui, console)
        self.alarms = Alarms()
        self.tabs: dict[Tab, viser.GuiTabHandle | viser.GuiFolderHandle] = {}

    def add_tabs(self, first: str = "") -> viser.GuiTabHandle | None:
        """Add the tabs below the main panel; return the one that an application labels `first`, if it has one."""
        panel = self._gui.add_panel()
        own = panel.add_tab(first) if first else None
        tabs = {name: panel.add_tab(name) for name in self._layout.tabs}
        panel.dock_below(self._gui.main_panel)
        panel.expand()  # also on a phone: jogging and gripper are below the buttons of the task
        hidden = self._gui.add_folder(None, visible=False)
        self.tabs = {tab: tabs.get(tab, hidden) for tab in TABS}
        return own

    def add_diagnostics(self, services: Iterable[str]) -> None:
        """Fill the tabs Health, Log and Tuning."""
        with self.tabs["Health"]:
            self.health = HealthPanel(self._gui, services)
        with self.tabs["Log"]:
            self.alarm_panel = AlarmPanel(self._gui, self._console, self.alarms)
            self.log = LogPanel(self._gui, self._console, self._layout.log_level)
        self.tuning = TuningPanel(self._gui, self.tabs["Tuning"], self._console)
