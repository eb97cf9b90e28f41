"""The operator's page: panels around the 3D scene, updated from the messages of the cell while a browser is connected.

An application extends it by an `ApplicationPage` (application.py).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Coroutine, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser

from common import topics
from common.application import Application
from common.config import Io, Members, RobotConfig
from common.messages import TaskStatus
from common.topics import Topic
from page.access import CURRENT_SESSION
from page.application import page_of
from page.belt_panel import BeltPanel
from page.camera_panel import CameraPanel
from page.console import EXECUTOR, Console
from page.control_socket import ARM_LOST, HOLD, STOP, TASK_LOST, ControlSocket, LossDetector, PageStatus
from page.diagnostics import SECONDS, Limits, PlotPanel
from page.feeds import ANNOTATED, DEPTH, LIVE, MASK, Feeds, Schedule, Topics, Updater
from page.hand_eye import HandEyePanel
from page.history import Timeline
from page.io_panel import IoPanel
from page.layers import Layers, shown_layers
from page.layout import Layout, LayoutSaver, ViewPanel
from page.markup import BAD
from page.move_panel import Motions, MovePanel
from page.panels import Panels
from page.recorded_history import HistoryRecorder, RecordedHistory, recordings_in
from page.situation import situation, summarize
from page.status_text import TaskText, arm_blocked, gripper_text
from page.subscriptions import Subscriptions
from page.time_panel import TimePanel
from page.viewpoint import keep_framed, prepare_scene
from page.viser_inside import send_key
from page.world_editing import WorldPanel

if TYPE_CHECKING:
    from common.robot.model import RobotModel
    from page.scene import Scene

PUBLISHED_PERIOD = 3.0  # [s] between two queries of the keys that are published in the cell


class Page:
    """All panels and the scene. Used on the loop of the service.

    Attributes:
        console: sends requests to the cell.
        timeline: the displayed time.
        pages: number of connected browsers.
        visited: set once a browser has connected.
    """

    def __init__(
        self, server: viser.ViserServer, feeds: Feeds, console: Console, motions: Motions, members: Members,
        application: Application | None, layers: Layers, control: ControlSocket, *, cell: str, layout: Layout,
        layout_file: str, robot: RobotConfig, recordings: Path, schedule: Schedule, io: Io,
        belts: Collection[str] = (), title: str = "",
    ) -> None:
        """Build the page; on the running loop.

        Args:
            server: that serves it.
            feeds: topics of the cell.
            console: sends requests to the cell.
            motions: plans and executes motions.
            members: of the cell.
            application: of the cell.
            layers: of the scene.
            control: the control socket of each browser.
            cell: its name.
            layout: initial layout.
            layout_file: configured path of the layout; empty: that of the user.
            robot: of the cell.
            recordings: folder of recordings that can be opened.
            schedule: update periods.
            io: inputs and outputs of the cell.
            belts: names of its conveyors.
            title: what the page is of: the cell, and its arm in a cell with several; default: the cell.

        Raises:
            UnknownName: the layout names a layer that does not exist.
        """
        self._server, self._feeds, self.console = server, feeds, console
        self._title = title or cell
        self._motions, self._cell, self._kinds, self._control = motions, cell, layers, control
        self._layout, self._schedule, self._recordings = layout, schedule, recordings
        self._topics, self._text = Topics(application, layers.values(), members.keys), TaskText.of(application)
        self._shown, self._editing = shown_layers(layout.layers, layers), layout.edit_world
        self._losses, self._task = LossDetector(), members.task  # its loss is shown as that of the task
        self._recorder = HistoryRecorder(feeds, self._text.states)
        self.timeline = Timeline(feeds.latest, self._recorder.recent)
        self._scene: Scene | None = None
        self._plots: PlotPanel | None = None
        self._move: MovePanel | None = None
        self._signals, self._belt_names = io, belts
        self._io: IoPanel | None = None
        self._belts: BeltPanel | None = None
        self.pages = 0
        self.visited = asyncio.Event()
        prepare_scene(server, layout, cell)
        self._panels = Panels(server, console, layout, self._title, self._text)
        create = page_of(application).controls
        self._controls = create(server.gui, console) if create is not None else None
        self._controls_updater = Updater(self._controls, feeds.latest) if self._controls is not None else None
        self._tab = page_of(application).tab
        self._own_tab = self._panels.add_tabs(self._tab.label if self._tab is not None else "")
        self._own: Any = None  # content of that tab
        self._subscriptions = Subscriptions(feeds, self._topics, layers, self._panels, self._recorder)
        self._fill_tabs(members, robot, layout_file)
        self._connect()

    # --- layout ---

    def _fill_tabs(self, members: Members, robot: RobotConfig, layout_file: str) -> None:
        gui, console, layout, panels = self._server.gui, self.console, self._layout, self._panels
        with panels.tabs["Cameras"]:
            self._cameras = CameraPanel(
                gui, console, {LIVE: layout.live_image, ANNOTATED: layout.annotated_image, MASK: layout.mask_image,
                               DEPTH: layout.depth_image}, self._select_topics)
        with panels.tabs["Cameras"], gui.add_folder("Hand-eye calibration", expand_by_default=False):
            self._hand_eye = HandEyePanel(gui, console, self._feeds.latest, self._topics.images[LIVE], robot,
                                          on_topics=self._select_topics)
        with panels.tabs["Time"]:
            self._time = TimePanel(gui, console, self.timeline, names=partial(recordings_in, self._recordings),
                                   open_recording=self._open_recording)
        panels.add_diagnostics(members.services)
        with panels.tabs["View"]:
            self._view = ViewPanel(
                gui, console, self._kinds, self._shown, shadows=layout.shadows, on_layer=self._set_layer,
                on_shadows=lambda on: self._server.scene.configure_default_lights(cast_shadow=on))
            gui.add_divider()
            self._world = WorldPanel(gui, console, editing=self._editing, on_editing=self._set_editing,
                                     on_reset=self._subscriptions.clear_rejected)
            LayoutSaver(gui, console, self._kinds, layout, layout_file, self._cell, self._layout_values)

    def _connect(self) -> None:
        """Connect console, control socket, timeline and browsers."""
        console, control = self.console, self._control
        console.notify, control.stop = self._panels.task.notify, self._panels.task.stop
        console.before_operation = self.timeline.return_to_present
        console.permissions.require(STOP, "stop", "STOP")
        console.permissions.require(HOLD, "operate", "jogs")
        self.timeline.on_seek = partial(self._schedule.hasten, "plots", "images")
        self.timeline.on_error = console.notify

        async def connected(client: viser.ClientHandle) -> None:
            if (session := CURRENT_SESSION.get()) is not None:
                send_key(client, console.permissions.issue_key(session))
            console.put(self._count_pages)
            await keep_framed(client)

        async def disconnected(_client: viser.ClientHandle) -> None:
            console.put(self._count_pages)

        self._server.on_client_connect(connected)
        self._server.on_client_disconnect(disconnected)

    def complete(self, scene: Scene, robot: RobotModel, planners: list[str]) -> None:
        """Add the parts that take long to load; the scene is updated from now on.

        Args:
            scene: of the server.
            robot: not used by another thread.
            planners: available planners.
        """
        gui = self._server.gui
        with self._panels.tabs["Plots"]:
            limits = Limits(robot.joint_names, robot.lower, robot.upper, robot.velocity)
            self._plots = PlotPanel(gui, limits, self._text.latency)
        with self._panels.tabs["Move"]:
            self._move = MovePanel(
                gui, self.console, self._motions, scene, robot, planners, cell=self._cell,
                planner=self._layout.planner, marker=self._layout.goal_marker, notify=self._panels.task.notify)
            self._control.hold_handler = self._move.jogger
            if self._signals.signals:
                with gui.add_folder("Inputs and outputs"):
                    self._io = IoPanel(gui, self.console, self._signals)
            if self._belt_names:
                with gui.add_folder("Conveyors"):
                    self._belts = BeltPanel(gui, self.console, self._belt_names)
        if self._tab is not None and self._own_tab is not None:
            with self._own_tab:
                self._own = self._tab.panel(gui, self.console, self._move.readout, scene.play)
        for name, on in self._shown.items():
            scene.set_shown(name, on)
        if self._editing:
            scene.set_editing(True)
        self._subscriptions.connect(scene, self._plots)
        self._scene = scene
        self.timeline.resend_images()

    @property
    def shown(self) -> dict[str, bool]:
        """Whether each layer of the scene is shown."""
        return dict(self._shown)

    def _layout_values(self) -> Mapping[str, Any]:
        """Return the current values of the layout."""
        images = self._cameras.shown
        motion = {"goal_marker": self._move.marker, "planner": self._move.planner} if self._move else {}
        return {"layers": self._shown, "live_image": images[LIVE], "annotated_image": images[ANNOTATED],
                "mask_image": images[MASK], "depth_image": images[DEPTH], "shadows": self._view.shadows,
                "log_level": self._panels.log.level, "edit_world": self._editing, **motion}

    # --- updates ---

    def refresh(self, now: float, alive: frozenset[str], connected: bool = True) -> None:
        """Update the page; without a browser only plots, history and status bar.

        Args:
            now: wall time [s], monotonic.
            alive: services that are ready.
            connected: whether the router is reachable.
        """
        if self._schedule.is_due("status_bar", now):
            self._publish_status(now, alive, connected)
        state = self._feeds.take(topics.JOINT_STATES)
        if state is not None and self._plots is not None:
            self._plots.add(state, now)
        if self._schedule.is_due("history", now):
            self._recorder.record(now)
        if not self.pages:
            return
        self.timeline.step(now)
        if self._schedule.is_due("task", now):
            self._show_panels(now)
        self._hand_eye.update(now)
        if self._schedule.is_due("diagnostics", now):
            self._panels.health.show(self._feeds.latest(topics.SUPERVISOR_STATUS), alive)
        if self._plots is not None and self._schedule.is_due("plots", now):
            self._show_plots(self._plots, now)
        if self._schedule.is_due("images", now):
            self._show_images(now)
        if self._controls_updater is not None:
            self._controls_updater.update(now)
        if self._scene is not None:
            self._scene.refresh(now)

    @property
    def _status(self) -> TaskStatus | None:
        return self._feeds.latest(self._topics.status) if self._topics.status is not None else None

    def _show_panels(self, now: float) -> None:
        latest = self._feeds.latest
        self._panels.task.show(self._status, latest(topics.MOTION_STATUS), latest(topics.MOTION_OWNER),
                               len(self._subscriptions.rejected.positions))
        if self._move is not None:
            self._move.show(self._status, now)
        blocked = arm_blocked(self._status, latest(topics.MOTION_STATUS))
        for panel in (self._io, self._belts):
            if panel is not None:
                panel.show(blocked)
        if self._own is not None:
            self._own.show(blocked, now)
        self._panels.controller.show(latest(topics.ROBOT_STATUS))
        self._panels.alarm_panel.show()
        self._panels.log.show()
        self._world.show()
        self._time.show(now)
        self._hand_eye.show()

    def _publish_status(self, now: float, alive: frozenset[str], connected: bool) -> None:
        """Publish the status bar of every page."""
        latest, task, panels = self._feeds.latest, self._panels.task, self._panels
        owner, permissions = latest(topics.MOTION_OWNER), self.console.permissions
        arm, has_task = (self.console.is_available(each) for each in (topics.MOTION_STOP, topics.TASK_COMMAND))
        responders = {"arm": (ARM_LOST, arm)} | ({"task": (TASK_LOST, has_task)} if self._task else {})
        lost = self._losses.update(connected, alive | {EXECUTOR, self._task}, responders, now)
        motion = latest(topics.MOTION_STATUS) if arm else None
        first = situation(self._text, self._status if has_task else None, motion, owner, latest(topics.ROBOT_STATUS))
        panels.alarms.update([*([first.text] if first.kind == BAD else []), *(loss.message for loss in lost)])
        self._control.publish(PageStatus(
            situation=first, summary=summarize(
                self._title, motion, gripper_text(latest(topics.GRIPPER_STATE)),
                permissions.operating_page if permissions.enforced else None, panels.alarms.unacknowledged),
            lost=tuple(lost), note=task.note, note_time=task.note_time, owner=owner,
            live=self._move.readout.live() if self._move is not None else {}, past=self._time.position))

    def _show_images(self, now: float) -> None:
        timeline = self.timeline
        for name, sources in self._topics.images.items():
            for topic in sources if self._cameras.shown[name] else ():
                image = self._feeds.take(topic) if timeline.is_present else timeline.image(topic)
                rgb = self._cameras.show(name, image, topic.key) if image is not None else None
                if rgb is None:
                    continue
                if timeline.is_present:
                    self._recorder.recent.add_image(now, topic, rgb)
                if name == LIVE and self._scene is not None:
                    self._scene.show_image(topic, rgb)

    def _show_plots(self, plots: PlotPanel, now: float) -> None:
        at = self.timeline.at
        if at is None:
            plots.show(now)
        else:
            plots.show_past(self.timeline.history.between(topics.JOINT_STATES, at - SECONDS, at), at)

    def _open_recording(self, name: str) -> RecordedHistory:
        """Open a recording; on any thread.

        Raises:
            RecordingError: it cannot be read.
        """
        return RecordedHistory(self._recordings / name, self._cell, self._feeds.topics, self._text.states)

    # --- background tasks ---

    def tasks(self, age_ms: Callable[[int], float]) -> list[Coroutine[Any, Any, None]]:
        """Return the coroutines to run concurrently with `refresh`, until cancelled.

        Args:
            age_ms: returns the wall time [ms] since a stamp.
        """
        return [self.console.run(), self._poll_parameters(), self._poll_published(),
                *self._subscriptions.tasks(age_ms)]

    async def _poll_published(self) -> None:
        """Offer layers and images once their topics are published; a restart of the publisher changes nothing."""
        published: set[str] = set()
        while True:
            if self.pages and not published >= (now := await self.console.published_keys()):
                published |= now
                self._view.offer(published)
                self._cameras.offer({name for name, sources in self._topics.images.items()
                                     if any(topic.key in published for topic in sources)})
            await asyncio.sleep(PUBLISHED_PERIOD)

    async def _poll_parameters(self) -> None:
        while True:
            if self.pages:
                self._panels.tuning.show(await self.console.parameters())
            await asyncio.sleep(1.0)

    # --- callbacks ---

    def _count_pages(self) -> None:
        before, self.pages = self.pages, len(self._server.get_clients())
        if self.pages and not before:
            self._schedule.hasten()
            self.visited.set()
        self._select_topics()

    def _select_topics(self) -> None:
        """Read only the on-demand topics that a page displays."""
        selected: list[Topic[Any]] = []
        if self.pages:
            selected += [topics.WRENCH, *(self._controls.TOPICS if self._controls is not None else ())]
            for name, kind in self._kinds.items():
                selected += kind.TOPICS if self._shown[name] or (kind.EDITS and self._editing) else ()
            selected += self._hand_eye.needed_topics
            for name, sources in self._topics.images.items():
                selected += sources if self._cameras.shown[name] else ()
        self._feeds.select(selected)
        self.timeline.resend_images()

    def _set_layer(self, name: str, on: bool) -> None:
        self._shown[name] = on
        if self._scene is not None:
            self._scene.set_shown(name, on)
        self._select_topics()

    def _set_editing(self, on: bool) -> None:
        self._editing = on
        if self._scene is not None:
            self._scene.set_editing(on)
        self._select_topics()
