"""Pick and place on the operator's page: targets, rejections, and reach of the arm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from applications.pick_place.topics import (
    DETECTED_OBJECTS,
    REJECTED_TARGETS,
    VALIDATED_TARGETS,
    WORKSPACE_MARKERS,
)
from common.messages import TaskStatus
from common.topics import Topic
from page.application import ApplicationPage
from page.layers import Layer
from page.nodes import FLAT, Labels, Markers, points_of, ring
from page.status_text import RejectedPosition, RejectedPositions, of_total, throughput

if TYPE_CHECKING:
    import viser

TARGET = (70, 220, 110)
REJECTED = (255, 90, 200)
_WIDER = 1.35  # radius of a ring relative to the ball
_STILL = 1e-3  # [m] noise of detections


def counters(status: TaskStatus, rejected: int) -> dict[str, object]:
    """Figures of the task by label."""
    return {"placed": of_total(status), **throughput(status), "rejected": rejected, "retries": status.retries,
            "failures": status.failures}


class Targets(Layer):
    """A ring around each target."""

    LABEL = "Targets"
    LEGEND = (("target", TARGET),)
    TOPICS = (VALIDATED_TARGETS,)

    def build(self) -> None:
        """Start without targets."""
        self._ring = ring(_WIDER * self.stage.around.ball_radius)
        # One mesh each: they share the shader of everything else; a shader of their own takes a browser
        # without a graphics card a moment.
        self.nodes: list[viser.MeshHandle] = []

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show these targets only."""
        at = points_of(message.poses)
        while len(self.nodes) > len(at):
            self.nodes.pop().remove()
        for node, place in zip(self.nodes, at, strict=False):
            if np.abs(node.position - place).max() >= _STILL:
                node.position = place
        for place in at[len(self.nodes) :]:
            self.nodes.append(self.scene.add_mesh_simple(
                f"{self.root}/{len(self.nodes)}", *self._ring, color=TARGET, position=place, **FLAT))


class Rejected(Layer):
    """A ring and the reason at each rejected position, until nothing is detected there any more."""

    LABEL = "Rejected, with the reason"
    LEGEND = (("rejected", REJECTED),)
    TOPICS = (REJECTED_TARGETS, VALIDATED_TARGETS, DETECTED_OBJECTS)
    PERIOD = 0.5

    def build(self) -> None:
        """Start without rejections."""
        self._ring = ring(_WIDER * self.stage.around.ball_radius)
        self.rejected = RejectedPositions()
        self.nodes: dict[RejectedPosition, tuple[str, viser.MeshHandle]] = {}  # with the name of its label
        self._count = 0
        self.labels = Labels(self.scene, self.root, scale=0.75)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Add rejections; remove those at a target, or without a detection for a while."""
        self.rejected.update(message)
        for place in [place for place in self.nodes if place not in self.rejected.positions]:
            self.nodes.pop(place)[1].remove()
        for place in self.rejected.positions:
            if place not in self.nodes:
                self._count += 1
                self.nodes[place] = str(self._count), self.scene.add_mesh_simple(
                    f"{self.root}/{self._count}_ring", *self._ring, color=REJECTED, position=place.at, **FLAT)
        self.labels.show({name: (place.reason, np.array(place.at)) for place, (name, _) in self.nodes.items()},
                         self.stage.projection())

    @property
    def reasons(self) -> list[str]:
        """Displayed reasons, oldest first."""
        return [place.reason for place in self.rejected.positions]


class Workspace(Layer):
    """The reachable shell and the excluded column around the base."""

    LABEL = "Workspace"
    ON = False
    TOPICS = (WORKSPACE_MARKERS,)

    def build(self) -> None:
        """Start without shapes."""
        self.markers = Markers(self.scene, self.root)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show these shapes only."""
        self.markers.show(message)


PAGE = ApplicationPage(
    layers=(Targets, Rejected, Workspace), states={"GRASPING": "Grasping", "PLACING": "Placing"},
    latency="Image to targets", counters=counters,
)
