"""Layout of the page: a YAML file of the user, written by "Save layout", else the default; and the View tab."""

from __future__ import annotations

import errno
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import viser
import yaml
from pydantic import Field

from common.atomic_file import state_folder, write_atomically
from common.config import Section, check, config_root, read_yaml
from common.errors import ConfigError, ZencellError
from page.diagnostics import LogLevel
from page.layers import Layers, has_data, shown_layers
from page.markup import Html, block, span, swatch, text
from page.viser_inside import element_id

if TYPE_CHECKING:
    from page.console import ActionQueue

FILE = "viewer.yaml"
Tab = Literal["Move", "Cameras", "Log", "View", "Plots", "Health", "Tuning", "Time"]
TABS: tuple[Tab, ...] = get_args(Tab)
HEADER = '# Layout of the operator\'s page. "Save layout" on the page writes this file.\n'
Coordinate = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]
Point = tuple[Coordinate, Coordinate, Coordinate]


class Viewpoint(Section):
    """Initial camera of the 3D scene."""

    position: Point = Field((1.9, -1.5, 1.4), description="of the camera in world [m]")
    look_at: Point = Field((0.35, 0.0, 0.3), description="center of the view in world [m]")


class Layout(Section):
    """What the page shows when it opens."""

    version: Literal[2] = Field(2, description="of the file; a file without it may be older than the tab Time")
    dark: bool = Field(True, description="dark theme")
    panel_width: Annotated[int, Field(ge=280, le=1200)] = Field(470, description="[px]")
    tabs: list[Tab] = Field([*TABS], description="in order; the first one is open")
    layers: dict[str, bool] = Field({}, description="visibility of layers that differs from their default")
    viewpoints: dict[str, Viewpoint] = Field({}, description="by cell")
    live_image: bool = Field(True, description="show the live image of the camera")
    annotated_image: bool = Field(True, description="show the image with the detections overlay")
    mask_image: bool = Field(False, description="show the color mask")
    depth_image: bool = Field(False, description="show the depth image")
    shadows: bool = Field(False, description="objects cast shadows; slow in a browser without a GPU")
    log_level: LogLevel = Field("info", description="lowest level of the log that is shown")
    edit_world: bool = Field(False, description="objects of the simulated world can be dragged")
    goal_marker: bool = Field(False, description="show the marker for a goal of the tool")
    planner: str = Field("pipeline", description="planner for motions of the operator")

    def viewpoint(self, cell: str) -> Viewpoint:
        """Return the initial camera for a cell."""
        return self.viewpoints.get(cell, Viewpoint())


# --- the file ---


def layout_file(configured: str) -> Path:
    """Return the path of the layout: the configured one, or that of this user."""
    return Path(configured).expanduser() if configured else state_folder() / FILE


def _user_layout() -> Path | None:
    """Return the file of this user, if it exists; the user of a container may have no home."""
    try:
        path = layout_file("")
        return path if path.is_file() else None
    except (ConfigError, OSError):
        return None


def load_layout(configured: str, warn: Callable[[str], None]) -> Layout:
    """Return the layout of the configured file, else of this user's file, else the project's default.

    A user's file that cannot be used causes a warning: the layout of the page must not keep a cell from starting.

    Raises:
        ConfigError: the configured file is missing, does not parse, or contains an unknown name.
    """
    if configured:
        return _read(layout_file(configured))
    if (path := _user_layout()) is not None:
        try:
            return _read(path)
        except ConfigError as error:
            warn(f"the page uses the default layout: {error}")
    path = config_root() / FILE
    return _read(path) if path.is_file() else Layout()


def _read(path: Path) -> Layout:
    layout = check(Layout, read_yaml(path), str(path))
    if "version" not in layout.model_fields_set and set(layout.tabs) == {*TABS} - {"Time"}:
        return layout.model_copy(update={"tabs": [*layout.tabs, "Time"]})
    return layout


def save_layout(configured: str, layout: Layout) -> Path:
    """Write the file atomically; return its path.

    Raises:
        OSError: it cannot be written.
    """
    path = layout_file(configured)
    values = layout.model_dump(mode="json")
    body = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)
    if path.exists() and not path.stat().st_mode & 0o222:  # a rename would ignore that
        raise PermissionError(errno.EACCES, "it is read-only", str(path))
    write_atomically(path, HEADER + body)
    return path


# --- the View tab ---


class ViewPanel:
    """A checkbox for each layer, the legend, and shadows.

    Attributes:
        shown: whether each layer is switched on.
        shadows: whether objects cast shadows.
    """

    def __init__(
        self, gui: viser.GuiApi, actions: ActionQueue, kinds: Layers, shown: Mapping[str, bool], *, shadows: bool,
        on_layer: Callable[[str, bool], None], on_shadows: Callable[[bool], None],
    ) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            actions: runs changes of the checkboxes.
            kinds: layers of the scene by name, in the order of their checkboxes.
            shown: initial state of each layer.
            shadows: initial state.
            on_layer: called with the name of a layer and its new state.
            on_shadows: called with the new state.
        """
        self._kinds, self._on_layer, self._on_shadows = kinds, on_layer, on_shadows
        self.shown, self.shadows = dict(shown), shadows
        self._checkboxes = {
            name: gui.add_checkbox(kind.LABEL or name, self.shown[name]) for name, kind in kinds.items()}
        for name, checkbox in self._checkboxes.items():
            actions.on_change(checkbox, partial(self._set, name), "look")
        Html(gui, block(span("This browser draws without a graphics card: the scene is slow.", "busy"), "software"))
        checkbox = gui.add_checkbox("Shadows", shadows, hint="slow in a browser without a GPU")
        actions.on_change(checkbox, self._set_shadows, "look")
        self._legend = Html(gui)
        self._show_legend()

    def offer(self, published: Collection[str]) -> None:
        """Show only the checkboxes of layers that have data, when these keys are published."""
        for name, kind in self._kinds.items():
            if self._checkboxes[name].visible is not (has := has_data(kind, published)):
                self._checkboxes[name].visible = has
        self._show_legend()

    def _set(self, name: str, on: bool) -> None:
        self.shown[name] = on
        self._show_legend()
        self._on_layer(name, on)

    def _set_shadows(self, on: bool) -> None:
        self.shadows = on
        self._on_shadows(on)

    def _show_legend(self) -> None:
        colors = {label: color for name, kind in self._kinds.items() for label, color in kind.LEGEND
                  if self.shown[name] and self._checkboxes[name].visible}
        lines = "".join(f"<div>{swatch(color)} {text(label)}</div>" for label, color in colors.items())
        self._legend.set(block(span("Legend", "dim") + lines, "legend", colors=len(colors)) if lines else "")


class LayoutSaver:
    """The button "Save layout", with its result."""

    def __init__(
        self, gui: viser.GuiApi, actions: ActionQueue, kinds: Layers, layout: Layout, file: str, cell: str,
        current: Callable[[], Mapping[str, Any]],
    ) -> None:
        """Add the button.

        Args:
            gui: of the server.
            actions: runs the button.
            kinds: layers of the scene.
            layout: with which the page has opened.
            file: configured path of the layout.
            cell: name of the cell.
            current: returns the current values of fields of the layout; `layers` with all layers.
        """
        self._kinds, self._layout, self._file, self._cell, self._current = kinds, layout, file, cell, current
        button = gui.add_button("Save layout", icon=viser.Icon.DEVICE_FLOPPY, hint=(
            "save the displayed layers, images and view of the scene: the page opens like this"))

        async def clicked(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            client = event.client
            actions.put(lambda: self._save(client))

        actions.permissions.require(element_id(button), "tune", "Save layout")
        button.on_click(clicked)
        self._note = Html(gui)

    def _save(self, client: viser.ClientHandle | None) -> None:
        values = dict(self._current())
        default = shown_layers({}, self._kinds)
        elsewhere = {name: on for name, on in self._layout.layers.items() if name not in default}
        values["layers"] = elsewhere | {name: on for name, on in values["layers"].items() if on != default[name]}
        try:
            if client is not None:
                camera = {"position": client.camera.position, "look_at": client.camera.look_at}
                viewpoint = check(Viewpoint, {name: [round(float(v), 3) for v in point]
                                              for name, point in camera.items()}, "viewpoint")
                values["viewpoints"] = self._layout.viewpoints | {self._cell: viewpoint}
            layout = self._layout.model_copy(update=values)
            path = save_layout(self._file, layout)
        except OSError as error:
            self._report(f"{error.filename or 'the layout'} cannot be written: {error.strerror}", "bad")
        except ZencellError as error:
            self._report(str(error), "bad")
        else:
            self._layout = layout
            self._report(f"Saved in {path}", "good")

    def _report(self, message: str, kind: str) -> None:
        self._note.set(block(span(message, kind), "layout", kind=kind))
