"""The operator's page: panels around the scene, fed with what the cell says while somebody looks.

An application adds to it in its part `page`: words for its task (words.py), layers of the scene (layers), and

    REQUESTS = (SELECT,)                                   # what its buttons and layers ask by `Console.ask`
    class Controls:                                        # its own buttons, below those of every task
        TOPICS, PERIOD = (CHOICES,), 0.5                   # as of a layer
        def __init__(self, gui: viser.GuiApi, console: Console) -> None:
        def show(self, topic: Topic[Any], message: Any) -> None:
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser

from common import topics
from common.application import Application
from common.config import Members, RobotConfig, check
from common.errors import ZencellError
from common.messages import Image, PointCloud2, Rejections, TaskStatus
from common.topics import Topic
from page import words
from page.application import page_of
from page.arm_panel import ArmPanel
from page.console import Console
from page.doors import VISITOR
from page.feeds import ANNOTATED, DEPTH, LIVE, MASK, Feeds, News, Periods, Topics
from page.hand_eye_panel import HandEyePanel
from page.health import HealthPanel, LogPanel
from page.layers import Layers, layers_shown
from page.layout import TABS, Layout, Tab, Viewpoint, save_layout
from page.line import HOLD, STOP, Line
from page.losses import Losses
from page.markup import block, span
from page.move import Motions, MovePanel
from page.past import Memory
from page.pictures import PicturePanel
from page.plots import SECONDS, Limits, PlotPanel
from page.recorded import RecordedPast, Watch, recordings_in
from page.rejections import RejectedPlaces
from page.task_panel import TaskPanel
from page.time_panel import TimePanel
from page.timeline import Timeline
from page.tuning import TuningPanel
from page.view_panel import ViewPanel
from page.viser_inside import introduce
from page.words import TaskWords, gripper
from page.world_panel import WorldPanel
from recording.report.summary import NOT_LEFT_BEHIND

if TYPE_CHECKING:
    from common.robot.model import RobotModel
    from page.scene import Scene

OFFER_PERIOD = 3.0  # [s] between two looks at what the cell has


class Page:
    """Everything that a browser shows. Used on the loop of the service.

    Attributes:
        pages: how many browsers look.
        visited: set once one has.
    """

    def __init__(
        self, server: viser.ViserServer, feeds: Feeds, console: Console, motions: Motions, members: Members,
        application: Application | None, layers: Layers, line: Line, *, cell: str, layout: Layout, layout_file: str,
        robot: RobotConfig, recordings: Path, periods: Periods,
    ) -> None:
        """Lay the page out; on the running loop.

        Args:
            server: that serves it.
            feeds: what the cell says.
            console: to the cell.
            motions: for the person.
            members: of the cell.
            application: what the cell is for.
            layers: of the scene.
            line: the other connection of each browser.
            cell: its name.
            layout: what is on.
            layout_file: where the layout is kept; empty for the project's file.
            robot: of the cell.
            recordings: folder of those that can be opened.
            periods: of the parts.

        Raises:
            UnknownName: the layout has a layer that there is not.
        """
        self._server, self._feeds, self.console = server, feeds, console
        self._motions, self._cell, self._kinds = motions, cell, layers
        self._layout, self._layout_file, self._periods = layout, layout_file, periods
        self._topics, self._words = Topics(application, layers.values(), members.keys), TaskWords.of(application)
        self._remembered = [topic for topic in feeds.topics
                            if topic.kind != "event" and not issubclass(topic.message, Image | PointCloud2)]
        self._shown, self._editing = layers_shown(layout.layers, layers), layout.edit_world
        self._rejected, self._line, self._losses = RejectedPlaces(), line, Losses()
        self._memory, self._watch = Memory(), Watch(self._words.states)
        self.timeline = Timeline(feeds.latest, self._memory)
        self._happened: list[tuple[Topic[Any], Any]] = []  # before there is a scene: an event does not come again
        self._scene: Scene | None = None
        self._plots: PlotPanel | None = None
        self._move: MovePanel | None = None
        self.pages = 0
        self.visited = asyncio.Event()
        _furnish(server, shadows=layout.shadows)
        gui = server.gui
        gui.configure_theme(dark_mode=layout.dark, show_logo=False, show_share_button=False)
        gui.set_panel_label(f"zencell · {cell}")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(layout.panel_width)
        self._task = TaskPanel(gui, console, self._words, self._home)
        console.tell, line.stop = self._task.tell, self._task.stop
        console.doors.need(STOP, "stop", "STOP")
        console.doors.need(HOLD, "operate", "jogs")
        self._arm = ArmPanel(gui, console)
        make = page_of(application).controls
        self._controls = make(gui, console) if make is not None else None
        self._news = News(self._controls, feeds.latest) if self._controls is not None else None
        panel = gui.add_panel()
        tabs = {name: panel.add_tab(name) for name in layout.tabs}
        panel.dock_below(gui.main_panel)
        hidden = gui.add_folder(None, visible=False)  # holds the panels that have no tab
        place: dict[Tab, viser.GuiTabHandle | viser.GuiFolderHandle] = {tab: tabs.get(tab, hidden) for tab in TABS}
        self._place = place
        with place["Cameras"]:
            self._pictures = PicturePanel(
                gui, console, {LIVE: layout.live_image, ANNOTATED: layout.annotated_image, MASK: layout.mask_image,
                               DEPTH: layout.depth_image}, self._listen)
        with place["Cameras"], gui.add_folder("Hand-eye calibration", expand_by_default=False):
            self._hand_eye = HandEyePanel(gui, console, feeds.latest, self._topics.images[LIVE], robot,
                                          on_listen=self._listen)
        with place["Time"]:
            self._time = TimePanel(gui, console, self.timeline, names=partial(recordings_in, recordings),
                                   open_one=partial(self._open_recording, recordings))
        self.timeline.moved = partial(self._periods.hurry_to, "plots", "picture")
        self.timeline.told = console.tell
        console.operated = self.timeline.now
        with place["Health"]:
            self._health = HealthPanel(gui, members.services)
        with place["Log"]:
            self._log = LogPanel(gui, console, layout.log_level)
        self._tuning = TuningPanel(gui, place["Tuning"], console)
        with place["View"]:
            self._lay_out_view(gui)
        viewpoint = layout.viewpoint(cell)
        server.initial_camera.position = viewpoint.position
        server.initial_camera.look_at = viewpoint.look_at

        async def count(_client: viser.ClientHandle) -> None:
            console.put(self._count)

        async def greet(client: viser.ClientHandle) -> None:
            if (visitor := VISITOR.get()) is not None:
                introduce(client, console.doors.key_of(visitor))
            console.put(self._count)

        server.on_client_connect(greet)
        server.on_client_disconnect(count)

    def _lay_out_view(self, gui: viser.GuiApi) -> None:
        """Ticks for the layers, one for editing the simulated world, and a button that saves the layout."""
        self._view = ViewPanel(
            gui, self.console, self._kinds, self._shown, shadows=self._layout.shadows, on_layer=self._set_layer,
            on_shadows=lambda on: self._server.scene.configure_default_lights(cast_shadow=on))
        gui.add_divider()
        self._world = WorldPanel(gui, self.console, editing=self._editing, on_editing=self._set_editing,
                                 on_reset=self._forget_rejected)
        button = gui.add_button("Save layout", icon=viser.Icon.DEVICE_FLOPPY,
                                hint="what is on now, and this view of the scene, is how the page opens")

        async def clicked(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            client = event.client
            self.console.put(lambda: self._save(client))

        self.console.doors.need(button._impl.uuid, "tune", "Save layout")
        button.on_click(clicked)
        self._note = gui.add_html("")

    # --- what is shown --------------------------------------------------------------------------------------------

    @property
    def shown(self) -> dict[str, bool]:
        """Whether each layer of the scene is shown."""
        return dict(self._shown)

    def complete(self, scene: Scene, robot: RobotModel, planners: list[str]) -> None:
        """Add what takes a while to load, and show what the cell says in the scene from now on.

        Args:
            scene: of the server.
            robot: not used by another thread.
            planners: that may be asked.
        """
        gui = self._server.gui
        with self._place["Plots"]:
            limits = Limits(robot.joint_names, robot.lower, robot.upper, robot.velocity)
            self._plots = PlotPanel(gui, limits, self._words.latency)
        with self._place["Move"]:
            self._move = MovePanel(gui, self.console, self._motions, scene, robot, planners, cell=self._cell,
                                   planner=self._layout.planner, marker=self._layout.goal_marker, tell=self._task.tell)
            self._line.holder = self._move.jogger
        for name, on in self._shown.items():
            scene.set_shown(name, on)
        if self._editing:
            scene.set_editing(True)
        for topic, event in self._happened:
            scene.happened(topic, event)
        self._happened.clear()
        self._scene = scene
        self.timeline.picture_anew()

    def refresh(self, now: float, alive: frozenset[str], connected: bool = True) -> None:
        """Show what is new at a wall time [s], monotonic; without a browser only what plots need is kept.

        Args:
            now: wall time.
            alive: the services that are ready.
            connected: whether the router is reached.
        """
        if self._periods.due("line", now):
            self._say_how(now, alive, connected)
        state = self._feeds.fresh(topics.JOINT_STATES)
        if state is not None and self._plots is not None:
            self._plots.measured(state, now)
        if self._periods.due("memory", now):
            self._remember(now)
        if not self.pages:
            return
        self.timeline.step(now)
        if self._periods.due("task", now):
            holding = self._feeds.latest(topics.GRIPPER_STATE)
            self._task.show(self._status, self._feeds.latest(topics.MOTION_STATUS),
                            self._feeds.latest(topics.MOTION_OWNER), gripper(holding), len(self._rejected.places))
            if self._move is not None:
                self._move.show(self._status, now)
            self._arm.show(self._feeds.latest(topics.ROBOT_STATUS))
            self._log.show()
            self._world.show()
            self._time.show(now)
            self._hand_eye.show()
        self._hand_eye.follow(now)
        if self._periods.due("health", now):
            self._health.show(self._feeds.latest(topics.SUPERVISOR_STATUS), alive)
        if self._plots is not None and self._periods.due("plots", now):
            self._plot(self._plots, now)
        if self._periods.due("picture", now):
            self._show_pictures(now)
        if self._news is not None:
            self._news.tell(now)
        if self._scene is not None:
            self._scene.refresh(now)

    @property
    def _status(self) -> TaskStatus | None:
        """What the task says of itself."""
        return self._feeds.latest(self._topics.status) if self._topics.status is not None else None

    def _say_how(self, now: float, alive: frozenset[str], connected: bool) -> None:
        """Bring up to date what stands above the page in every browser."""
        motion, owner = self._feeds.latest(topics.MOTION_STATUS), self._feeds.latest(topics.MOTION_OWNER)
        does = "is jogged" if owner is not None and owner.jogging else words.motion(motion)
        how = [(self._cell, "dim"), self._words.state(self._status), (f"arm {does}", "")]
        if owner is not None and owner.kind != "none":
            how.append((f"motion: {owner.owner or 'the task'}", "dim"))
        if self.console.doors.guarded:
            how.append((f"operates: {self.console.doors.operator or 'nobody'}", "dim"))
        answers = {"arm": ("The arm's controller does not answer: where it is nobody knows, and STOP may not reach it",
                           self.console.answers(topics.MOTION_STOP)),
                   "task": ("The task does not answer: what it does is not known",
                            self.console.answers(topics.TASK_COMMAND))}
        lost = self._losses.update(connected, alive, answers, now)
        self._line.tell(how, lost, self._task.note, owner,
                        self._move.numbers.live() if self._move is not None else {}, self._time.told)

    def _show_pictures(self, now: float) -> None:
        timeline = self.timeline
        for name, sources in self._topics.images.items():
            for topic in sources if self._pictures.shown[name] else ():
                image = self._feeds.fresh(topic) if timeline.is_now else timeline.picture(topic)
                rgb = self._pictures.show(name, image, topic.key) if image is not None else None
                if rgb is None:
                    continue
                if timeline.is_now:
                    self._memory.note_picture(now, topic, rgb)
                if name == LIVE and self._scene is not None:
                    self._scene.picture(topic, rgb)

    def _plot(self, plots: PlotPanel, now: float) -> None:
        at = self.timeline.at
        if at is None:
            plots.show(now)
        else:
            plots.show_past(self.timeline.past.between(topics.JOINT_STATES, at - SECONDS, at), at)

    def _remember(self, now: float) -> None:
        """Keep what is new, so that somebody may look back at it."""
        for topic in self._remembered:
            if (message := self._feeds.latest(topic)) is not None and self._memory.note(now, topic, message):
                for words_, kind in self._watch.news(message):
                    self._memory.happened(now, words_, kind)

    def _open_recording(self, folder: Path, name: str) -> RecordedPast:
        """Open a recording of that folder; on any thread.

        Raises:
            RecordingError: it cannot be read.
        """
        return RecordedPast(folder / name, self._cell, self._feeds.topics, self._words.states)

    # --- what goes on beside ------------------------------------------------------------------------------------------

    def activities(self, age_ms: Callable[[int], float]) -> list[Coroutine[Any, Any, None]]:
        """What has to run beside `refresh`, until cancelled.

        Args:
            age_ms: wall time [ms] since a stamp was taken.
        """
        now = asyncio.get_running_loop().time

        def older(message: Any) -> None:
            if self._plots is not None:
                self._plots.latency(age_ms(message.header.stamp), now())

        def reject(rejections: Rejections) -> None:
            left = [each for each in rejections.rejected if NOT_LEFT_BEHIND not in each.reason]
            self._rejected.hear(rejections.model_copy(update={"rejected": left}))
            for said, kind in self._watch.news(rejections):
                self._memory.happened(now(), said, kind)

        acts: dict[Topic[Any], list[Callable[[Any], None]]] = {
            topics.LOG: [self._log.add], topics.COUNTERS: [lambda counters: self._health.count(counters, now())],
        }
        for topic in self._topics.decided_by:
            acts.setdefault(topic, []).extend((older, self._rejected.hear))
        for topic in self._topics.rejected:
            acts.setdefault(topic, []).append(reject)
        for topic in self._topics.detected:
            acts.setdefault(topic, []).append(self._rejected.hear)
        for topic in {topic for kind in self._kinds.values() for topic in kind.TOPICS if topic.kind == "event"}:
            acts.setdefault(topic, []).append(partial(self._happen, topic))
        others = (self._follow(*each) for each in acts.items())
        return [self.console.run(), self._follow_parameters(), self._offer(), *others]

    async def _follow(self, topic: Topic[Any], acts: list[Callable[[Any], None]]) -> None:
        if (reader := self._feeds.reader(topic)) is not None:
            async for message in reader:
                for act in acts:
                    act(message)

    def _happen(self, topic: Topic[Any], event: Any) -> None:
        if self._scene is not None:
            self._scene.happened(topic, event)
        else:
            self._happened.append((topic, event))

    async def _offer(self) -> None:
        """Have ticks for those layers and pictures only that the cell has anything for."""
        there: set[str] = set()  # also what is restarting
        while True:
            if self.pages and not there >= (now := await self.console.written()):
                there |= now
                self._view.offer(there)
                self._pictures.offer({name for name, sources in self._topics.images.items()
                                      if any(topic.key in there for topic in sources)})
            await asyncio.sleep(OFFER_PERIOD)

    async def _follow_parameters(self) -> None:
        while True:
            if self.pages:
                self._tuning.show(await self.console.parameters())
            await asyncio.sleep(1.0)

    # --- what persons do ------------------------------------------------------------------------------------------

    def _count(self) -> None:
        before, self.pages = self.pages, len(self._server.get_clients())
        if self.pages and not before:
            self._periods.hurry()
            self.visited.set()
        self._listen()

    def _listen(self) -> None:
        """Read what somebody sees, and nothing else of what is read on demand."""
        wanted: list[Topic[Any]] = []
        if self.pages:
            wanted += self._controls.TOPICS if self._controls is not None else ()
            for name, kind in self._kinds.items():
                wanted += kind.TOPICS if self._shown[name] or (kind.EDITS and self._editing) else ()
            wanted += self._hand_eye.wanted
            for name, sources in self._topics.images.items():
                wanted += sources if self._pictures.shown[name] else ()
        self._feeds.listen(wanted)
        self.timeline.picture_anew()

    async def _home(self) -> None:
        if self._move is None:
            self._task.tell("The page is still loading: try again in a moment.", "busy")
        else:
            await self._move.go_home()

    def _set_layer(self, name: str, on: bool) -> None:
        self._shown[name] = on
        if self._scene is not None:
            self._scene.set_shown(name, on)
        self._listen()

    def _forget_rejected(self) -> None:
        """After a reset, where no detection tells that what was rejected lies there no more."""
        if not self._topics.detected:
            self._rejected.places.clear()

    def _set_editing(self, on: bool) -> None:
        self._editing = on
        if self._scene is not None:
            self._scene.set_editing(on)
        self._listen()

    def _save(self, client: viser.ClientHandle | None) -> None:
        usual = layers_shown({}, self._kinds)
        elsewhere = {name: on for name, on in self._layout.layers.items() if name not in usual}
        viewpoints = dict(self._layout.viewpoints)
        motion = {"goal_marker": self._move.marker, "planner": self._move.planner} if self._move else {}
        try:
            if client is not None:
                seen = {"position": client.camera.position, "look_at": client.camera.look_at}
                viewpoints[self._cell] = check(Viewpoint, {name: [round(float(v), 3) for v in point]
                                                           for name, point in seen.items()}, "viewpoint")
            layout = self._layout.model_copy(update={
                "layers": elsewhere | {name: on for name, on in self._shown.items() if on != usual[name]},
                "viewpoints": viewpoints, "live_image": self._pictures.shown[LIVE],
                "annotated_image": self._pictures.shown[ANNOTATED], "mask_image": self._pictures.shown[MASK],
                "depth_image": self._pictures.shown[DEPTH], "shadows": self._view.shadows, "log_level": self._log.level,
                "edit_world": self._editing, **motion,
            })
            path = save_layout(self._layout_file, layout)
        except OSError as error:
            self._say(f"{error.filename or 'the layout'} cannot be written: {error.strerror}", "bad")
        except ZencellError as error:
            self._say(str(error), "bad")
        else:
            self._layout = layout
            self._say(f"Saved in {path}", "good")

    def _say(self, line: str, kind: str) -> None:
        """How saving went."""
        self._note.content = block(span(line, kind), "layout", kind=kind)


def _furnish(server: viser.ViserServer, *, shadows: bool) -> None:
    """Set light and lens. Before anything else is sent: what was drawn in another light has to get new shaders."""
    scene, view = server.scene, server.initial_camera
    scene.set_up_direction("+z")
    scene.configure_default_lights(cast_shadow=shadows)
    scene.configure_environment_map(hdri=None)  # a browser without a graphics card needs seconds to prepare one
    scene.add_light_hemisphere("/sky", sky_color=(255, 255, 255), ground_color=(120, 115, 110), intensity=2.0)
    scene.world_axes.visible = False
    view.up = (0.0, 0.0, 1.0)
    view.fov = 0.9
