"""The part of an application that extends the operator's page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from common.application import Application
from common.messages import MotionStatus, TaskStatus
from common.topics import Request


@dataclass(frozen=True)
class ApplicationTab:
    """A tab of an application, the first one of the page.

    Attributes:
        label: of the tab.
        panel: class of its content, created with `(gui, console, readout, play)` once the robot is loaded: `readout`
            is a `page.manual_control.ArmReadout`, and `play(trajectory)` animates the ghost of the robot. Its method
            `show(arm_blocked, now)` updates it while a browser is connected: why no operator can move the arm now, or
            an empty text; wall time [s], monotonic.
    """

    label: str
    panel: Callable[..., Any]


@dataclass(frozen=True, kw_only=True)
class ApplicationPage:
    """Layers, controls and labels of an application; see `Application.page`."""

    layers: Sequence[type[Any]] = ()
    """Layers of the 3D scene, classes derived from `page.layers.Layer`."""
    controls: Callable[..., Any] | None = None
    """Class of the controls below the task's buttons, created with `(gui, console)`; has TOPICS, PERIOD and `show`."""
    tab: ApplicationTab | None = None
    """A tab of its own."""
    requests: Sequence[Request[Any, Any]] = ()
    """Requests that controls, tab and layers send by `Console.call`."""
    states: Mapping[str, str] = field(default_factory=dict)
    """Labels of its task states, in addition to IDLE, HOMING, DONE and ERROR."""
    latency: str = "Image to decision"
    """Label of the age of `ApplicationTopics.decided_by`."""
    counters: Callable[[TaskStatus, int], Mapping[str, object]] | None = None
    """Figures shown below the state, from the status and the number of rejections."""
    progress: Callable[[TaskStatus, MotionStatus | None], float] | None = None
    """Progress of the bar, 0 to 1."""


def page_of(application: Application | None) -> ApplicationPage:
    """Return what an application adds to the page; nothing without an application."""
    found = application.page if application is not None else None
    return found if isinstance(found, ApplicationPage) else ApplicationPage()
