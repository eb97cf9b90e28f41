"""The part of an application that extends the operator's page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from common.application import Application
from common.messages import MotionStatus, TaskStatus
from common.topics import Request


@dataclass(frozen=True, kw_only=True)
class ApplicationPage:
    """Layers, controls and labels of an application; see `Application.page`."""

    layers: Sequence[type[Any]] = ()
    """Layers of the 3D scene, classes derived from `page.layers.Layer`."""
    controls: Callable[..., Any] | None = None
    """Class of the controls below the task's buttons, created with `(gui, console)`; has TOPICS, PERIOD and `show`."""
    requests: Sequence[Request[Any, Any]] = ()
    """Requests that controls and layers send by `Console.call`."""
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
