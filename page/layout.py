"""How the page opens: a file of the user, which "Save layout" on the page writes; before that the project's."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, get_args

import yaml
from pydantic import Field

from common.atomic_file import state_folder
from common.config import Section, check, config_root, read_yaml
from common.errors import ConfigError
from page.taught import write_whole

FILE = "viewer.yaml"
Tab = Literal["Cameras", "Health", "Plots", "Log", "Tuning", "Move", "View", "Time"]
TABS: tuple[Tab, ...] = get_args(Tab)
LogLevel = Literal["debug", "info", "warning", "error"]
HEADER = '# How the operator\'s page opens. "Save layout" on the page writes this file.\n'
Far = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]
View3D = tuple[Far, Far, Far]


class Viewpoint(Section):
    """From where the scene is seen."""

    position: View3D = Field((1.9, -1.5, 1.4), description="of the eye in world [m]")
    look_at: View3D = Field((0.35, 0.0, 0.3), description="what is in the middle, in world [m]")


class Layout(Section):
    """What is on when the page opens."""

    version: Literal[2] = Field(2, description="of the file; one without it may be from before there was the tab Time")
    dark: bool = Field(True, description="light letters on a dark ground")
    panel_width: Annotated[int, Field(ge=280, le=1200)] = Field(470, description="[px]")
    tabs: list[Tab] = Field([*TABS], description="in order; the first is open")
    layers: dict[str, bool] = Field({}, description="layers of the scene that are other than usual")
    viewpoints: dict[str, Viewpoint] = Field({}, description="by cell")
    live_image: bool = Field(True, description="the picture as the camera sends it")
    annotated_image: bool = Field(True, description="the picture with what was found in it")
    mask_image: bool = Field(False, description="what the colours that are looked for let through")
    depth_image: bool = Field(False, description="the depths that a depth camera measures")
    shadows: bool = Field(False, description="things throw shadows; slow in a browser without a graphics card")
    log_level: LogLevel = Field("info", description="lines below it are not shown")
    edit_world: bool = Field(False, description="objects of the simulated world can be dragged")
    goal_marker: bool = Field(False, description="the marker that tells a goal for the tool is shown")
    planner: str = Field("pipeline", description="which planner a motion is asked of")

    def viewpoint(self, cell: str) -> Viewpoint:
        """From where the scene of a cell is seen."""
        return self.viewpoints.get(cell, Viewpoint())


def layout_file(given: str) -> Path:
    """The file of the layout: the one that was given, or this user's own."""
    return Path(given).expanduser() if given else state_folder() / FILE


def _own_layout() -> Path | None:
    """This user's file, if there is one and a folder for it: a container's user may have no home."""
    try:
        path = layout_file("")
        return path if path.is_file() else None
    except (ConfigError, OSError):
        return None


def load_layout(given: str, tell: Callable[[str], None]) -> Layout:
    """The layout in a file; without one this user's own, else the project's.

    One of this user's that cannot be used is told in a line: no cell stays down for how its page looks.

    Raises:
        ConfigError: the file that was given is not there, does not parse, or names something unknown.
    """
    if given:
        return _read(layout_file(given))
    if (own := _own_layout()) is not None:
        try:
            return _read(own)
        except ConfigError as error:
            tell(f"the page opens as the project has it: {error}")
    path = config_root() / FILE
    return _read(path) if path.is_file() else Layout()


def _read(path: Path) -> Layout:
    layout = check(Layout, read_yaml(path), str(path))
    if "version" not in layout.model_fields_set and set(layout.tabs) == {*TABS} - {"Time"}:
        return layout.model_copy(update={"tabs": [*layout.tabs, "Time"]})
    return layout


def save_layout(given: str, layout: Layout) -> Path:
    """Write the file, all of it or nothing; returns where it is.

    Raises:
        OSError: it cannot be written.
    """
    path = layout_file(given)
    values = layout.model_dump(mode="json")
    body = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)
    if path.exists() and not path.stat().st_mode & 0o222:  # a rename would not ask
        raise PermissionError(errno.EACCES, "it is read-only", str(path))
    write_whole(path, HEADER + body)
    return path
