"""The operator's page: panels around the scene, fed with what the cell says while somebody looks."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any

import viser

from common import topics
from common.applications.outlining.messages import OutlineSelect
from common.applications.outlining.topics import CONTOUR_IMAGE, CONTOUR_PATH, CONTOURS, OUTLINE_STATUS
from common.applications.pick_place.topics import (
    DETECTION_IMAGE,
    PICK_PLACE_STATUS,
    REJECTED_TARGETS,
    VALIDATED_TARGETS,
)
from common.config import Members, check
from common.errors import ZencellError
from common.messages import Image
from common.reporting.summary import Rejected
from common.topics import Topic
from common.viewer.desk import Desk
from common.viewer.feeds import Feeds
from common.viewer.health import HealthPanel
from common.viewer.layers import layers_shown
from common.viewer.layout import TABS, Layout, Tab, Viewpoint, save_layout
from common.viewer.log_panel import LogPanel
from common.viewer.move_panel import Motions, MovePanel
from common.viewer.periods import Periods
from common.viewer.pictures import ANNOTATED, LIVE, PicturePanel
from common.viewer.plots import Limits, PlotPanel
from common.viewer.requests import Requests
from common.viewer.scene_feed import SceneFeed
from common.viewer.surface import furnish
from common.viewer.task_panel import TaskPanel
from common.viewer.tuning import TuningPanel
from common.viewer.view_panel import ViewPanel
from common.viewer.words import gripper

if TYPE_CHECKING:
    from common.viewer.scene_view import SceneView

OUTLINER = "contour_tracer"
IMAGES: dict[str, tuple[Topic[Image], ...]] = {
    LIVE: (topics.CAMERA_IMAGE, topics.DEPTH_CAMERA_IMAGE),
    ANNOTATED: (DETECTION_IMAGE, CONTOUR_IMAGE),
}
STAMPED: tuple[Topic[Any], ...] = (VALIDATED_TARGETS, CONTOUR_PATH)  # with when the picture was taken


class Page:
    """Everything that a browser shows. Used on the loop of the service.

    Attributes:
        desk: carries out what persons do.
        pages: how many browsers look.
        visited: set once one has.
    """

    def __init__(
        self, server: viser.ViserServer, feeds: Feeds, requests: Requests, motions: Motions, members: Members, *,
        cell: str, layout: Layout, layout_file: str, periods: Periods,
    ) -> None:
        """Lay the page out; on the running loop.

        Args:
            server: that serves it.
            feeds: what the cell says.
            requests: to the cell.
            motions: for the person.
            members: of the cell.
            cell: its name.
            layout: what is on.
            layout_file: where the layout is kept; empty for the project's file.
            periods: of the parts.
        """
        self._server, self._feeds, self._requests = server, feeds, requests
        self._motions, self._cell = motions, cell
        self._layout, self._layout_file, self._periods = layout, layout_file, periods
        self._scene = SceneFeed(feeds, periods, layout.layers, layout.edit_world)
        self._rejected = Rejected()
        self._plots: PlotPanel | None = None
        self._move: MovePanel | None = None
        self.pages = 0
        self.visited = asyncio.Event()
        self.desk = Desk(asyncio.get_running_loop(), self._tell)
        furnish(server)
        gui = server.gui
        gui.configure_theme(dark_mode=layout.dark, show_logo=False, show_share_button=False)
        gui.set_panel_label(f"zencell · {cell}")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(layout.panel_width)
        self._task = TaskPanel(gui, self.desk, requests, outlines=members.task == OUTLINER, home=self._home)
        panel = gui.add_panel()
        tabs = {name: panel.add_tab(name) for name in layout.tabs}
        panel.dock_below(gui.main_panel)
        hidden = gui.add_folder(None, visible=False)  # holds the panels that have no tab
        place: dict[Tab, viser.GuiTabHandle | viser.GuiFolderHandle] = {tab: tabs.get(tab, hidden) for tab in TABS}
        self._place = place
        with place["Cameras"]:
            self._pictures = PicturePanel(
                gui, self.desk, {LIVE: layout.live_image, ANNOTATED: layout.annotated_image}, self._listen)
        with place["Health"]:
            self._health = HealthPanel(gui, members.services)
        with place["Log"]:
            self._log = LogPanel(gui, self.desk, layout.log_level)
        self._tuning = TuningPanel(gui, place["Tuning"], self.desk, requests)
        with place["View"]:
            self._view = ViewPanel(gui, self.desk, self._scene.layers, self._scene.editing, on_layer=self._set_layer,
                                   on_editing=self._set_editing, on_save=self._save)
        viewpoint = layout.viewpoint(cell)
        server.initial_camera.position = viewpoint.position
        server.initial_camera.look_at = viewpoint.look_at

        async def count(_client: viser.ClientHandle) -> None:
            self.desk.put(self._count)

        server.on_client_connect(count)
        server.on_client_disconnect(count)

    def _tell(self, line: str) -> None:
        self._task.tell(line)

    # --- what is shown --------------------------------------------------------------------------------------------

    @property
    def layers(self) -> dict[str, bool]:
        """Whether each layer of the scene is shown."""
        return dict(self._scene.layers)

    def complete(self, scene: SceneView, limits: Limits, planners: list[str]) -> None:
        """Add what takes a while to load, and show what the cell says in the scene from now on.

        Args:
            scene: of the server.
            limits: of the joints.
            planners: that may be asked.
        """
        gui = self._server.gui
        with self._place["Plots"]:
            seen = "Picture to targets" if VALIDATED_TARGETS in self._feeds else "Picture to path"
            self._plots = PlotPanel(gui, limits, seen)
        with self._place["Move"]:
            self._move = MovePanel(gui, self.desk, self._motions, scene, planners, planner=self._layout.planner,
                                   marker=self._layout.goal_marker, tell=self._task.tell, play=self._scene.play)
        scene.on_select = lambda index: self.desk.put(lambda: self._select(index))
        scene.on_object_dragged = lambda name, x, y: self.desk.put(lambda: self._requests.move(name, x, y))
        self._scene.begin(scene)

    def refresh(self, now: float, alive: frozenset[str]) -> None:
        """Show what is new at a wall time [s], monotonic; without a browser only what plots need is kept.

        Args:
            now: wall time.
            alive: the services that are ready.
        """
        state = self._feeds.fresh(topics.JOINT_STATES)
        if state is not None and self._plots is not None:
            self._plots.measured(state, now)
        if not self.pages:
            return
        if self._periods.due("task", now):
            task = self._feeds.latest(OUTLINE_STATUS) or self._feeds.latest(PICK_PLACE_STATUS)
            holding = self._feeds.latest(topics.GRIPPER_STATE)
            self._task.show(task, self._feeds.latest(topics.MOTION_STATUS), gripper(holding),
                            len(self._rejected.places))
            self._log.show()
        if self._periods.due("health", now):
            self._health.show(self._feeds.latest(topics.SUPERVISOR_STATUS), alive)
        if self._plots is not None and self._periods.due("plots", now):
            self._plots.show(now)
        if self._periods.due("picture", now):
            self._show_pictures(now)
        contours = self._feeds.fresh(CONTOURS) if self._periods.due("contours", now) else None
        if contours is not None:
            self._task.show_contours(contours)
        self._scene.show(state, contours, now)

    def _show_pictures(self, now: float) -> None:
        for name, sources in IMAGES.items():
            for topic in sources:
                image = self._feeds.fresh(topic) if self._pictures.shown[name] else None
                rgb = self._pictures.show(name, image) if image is not None else None
                if rgb is not None and name == LIVE:
                    self._scene.picture(rgb, now)

    # --- what goes on beside ------------------------------------------------------------------------------------------

    def activities(self, age_ms: Callable[[int], float]) -> list[Coroutine[Any, Any, None]]:
        """What has to run beside `refresh`, until cancelled.

        Args:
            age_ms: wall time [ms] since a stamp was taken.
        """
        return [self.desk.run(), self._follow_log(), self._follow_counters(), self._follow_rejected(),
                self._follow_parameters(), *(self._follow_latency(topic, age_ms) for topic in STAMPED)]

    async def _follow_log(self) -> None:
        if (reader := self._feeds.reader(topics.LOG)) is not None:
            async for line in reader:
                self._log.add(line)

    async def _follow_counters(self) -> None:
        if (reader := self._feeds.reader(topics.COUNTERS)) is not None:
            async for counters in reader:
                self._health.count(counters, asyncio.get_running_loop().time())

    async def _follow_rejected(self) -> None:
        if (reader := self._feeds.reader(REJECTED_TARGETS)) is not None:
            async for rejections in reader:
                self._scene.reject(rejections)
                self._rejected.add(rejections.rejected)

    async def _follow_latency(self, topic: Topic[Any], age_ms: Callable[[int], float]) -> None:
        if (reader := self._feeds.reader(topic)) is not None:
            async for message in reader:
                if self._plots is not None:
                    self._plots.latency(age_ms(message.header.stamp), asyncio.get_running_loop().time())

    async def _follow_parameters(self) -> None:
        while True:
            if self.pages:
                self._tuning.show(await self._requests.parameters())
            await asyncio.sleep(1.0)

    # --- what persons do ------------------------------------------------------------------------------------------

    def _count(self) -> None:
        before, self.pages = self.pages, len(self._server.get_clients())
        if self.pages and not before:
            self._periods.hurry()
            self.visited.set()
        self._listen()

    def _listen(self) -> None:
        wanted: list[Topic[Any]] = []
        if self.pages:
            wanted += self._scene.wanted()
            for name, sources in IMAGES.items():
                wanted += sources if self._pictures.shown[name] else ()
        self._feeds.listen(wanted)

    async def _home(self) -> None:
        if self._move is None:
            self._task.tell("The page is still loading: try again in a moment.", "busy")
        else:
            await self._move.go_home()

    async def _select(self, index: int) -> None:
        await self._task.choose(OutlineSelect(rule="index", index=index))

    def _set_layer(self, name: str, on: bool) -> None:
        self._scene.set_layer(name, on)
        self._listen()

    def _set_editing(self, on: bool) -> None:
        self._scene.set_editing(on)
        self._listen()

    def _chosen_motion(self) -> dict[str, object]:
        return {"goal_marker": self._move.marker, "planner": self._move.planner} if self._move else {}

    def _save(self, client: viser.ClientHandle | None) -> None:
        usual = layers_shown({})
        viewpoints = dict(self._layout.viewpoints)
        try:
            if client is not None:
                seen = {"position": client.camera.position, "look_at": client.camera.look_at}
                viewpoints[self._cell] = check(Viewpoint, {name: [round(float(v), 3) for v in point]
                                                           for name, point in seen.items()}, "viewpoint")
            layout = self._layout.model_copy(update={
                "layers": {name: on for name, on in self._scene.layers.items() if on != usual[name]},
                "viewpoints": viewpoints, "live_image": self._pictures.shown[LIVE],
                "annotated_image": self._pictures.shown[ANNOTATED], "log_level": self._log.level,
                "edit_world": self._scene.editing, **self._chosen_motion(),
            })
            path = save_layout(self._layout_file, layout)
        except OSError as error:
            self._view.tell(f"{error.filename or 'the layout'} can not be written: {error.strerror}", "bad")
        except ZencellError as error:
            self._view.tell(str(error), "bad")
        else:
            self._layout = layout
            self._view.tell(f"Saved in {path}", "good")
