"""Pick and place on the operator's page: its words, the targets, what was rejected, and how far the arm reaches."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from common.applications.pick_place.topics import (
    DETECTED_OBJECTS,
    REJECTED_TARGETS,
    VALIDATED_TARGETS,
    WORKSPACE_MARKERS,
)
from common.messages import MarkerArray, PoseArray, Rejections, TaskStatus
from common.topics import Topic
from common.viewer.labels import Labels
from common.viewer.layers import Layer
from common.viewer.nodes import FLAT, Markers, Position, points_of, position_of, ring

if TYPE_CHECKING:
    import viser

STATES = {"GRASPING": "Taking", "PLACING": "Placing"}
LATENCY = "Picture to targets"

TARGET = (70, 220, 110)
REJECTED = (255, 90, 200)
_WIDER = 1.35  # than what lies there, a ring is
_STILL = 1e-3  # [m] detections tremble by less
_SAME_PLACE = 0.03  # [m] a rejection this near to another, or to a target, is of the same thing
_FORGET_AFTER = 3_000_000_000  # [ns, cell time] without a detection there; the validator takes 2 s
_MOST = 60  # rejections that are kept


def counters(status: TaskStatus, rejected: int) -> dict[str, object]:
    """The figures of the task by their names."""
    return {"placed": status.done, "targets": status.total, "rejected": rejected, "retries": status.retries,
            "failures": status.failures}


class Targets(Layer):
    """A ring about each target."""

    LABEL = "Targets"
    LEGEND = (("target", TARGET),)
    TOPICS = (VALIDATED_TARGETS,)

    def build(self) -> None:
        """Start without any."""
        self._ring = ring(_WIDER * self.stage.around.ball_radius)
        # A mesh each: their shader is that of everything else, and a browser without a graphics card needs a moment
        # for one of their own.
        self.nodes: list[viser.MeshHandle] = []

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show these targets and no others."""
        at = points_of(message.poses)
        while len(self.nodes) > len(at):
            self.nodes.pop().remove()
        for node, place in zip(self.nodes, at, strict=False):
            if np.abs(node.position - place).max() >= _STILL:
                node.position = place
        for place in at[len(self.nodes) :]:
            self.nodes.append(self.scene.add_mesh_simple(
                f"{self.root}/{len(self.nodes)}", *self._ring, color=TARGET, position=place, **FLAT))


@dataclass
class _Known:
    at: Position
    reason: str
    since: int  # stamp of the rejection [ns]
    seen: int  # newest time [ns] at which something was detected there
    name: str  # of its label
    node: viser.MeshHandle


class Rejected(Layer):
    """A ring and the reason at each place from which something was rejected, until nothing is there any more."""

    LABEL = "Rejected, with the reason"
    LEGEND = (("rejected", REJECTED),)
    TOPICS = (REJECTED_TARGETS, VALIDATED_TARGETS, DETECTED_OBJECTS)
    PERIOD = 0.5

    def build(self) -> None:
        """Start without any."""
        self._ring = ring(_WIDER * self.stage.around.ball_radius)
        self.known: list[_Known] = []
        self._count = 0
        self.labels = Labels(self.scene, self.root, scale=0.75)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Add rejections; forget those where a target is, or where nothing has been detected for a while."""
        if isinstance(message, Rejections):
            self._add(message)
        elif isinstance(message, PoseArray):
            targets = [position_of(pose) for pose in message.poses]
            self._drop([k for k in self.known if message.header.stamp >= k.since and _near(k.at, targets)])
        elif isinstance(message, MarkerArray):
            places = [position_of(marker.pose) for marker in message.markers]
            for known in self.known:
                if _near(known.at, places):
                    known.seen = max(known.seen, message.header.stamp)
            self._drop([known for known in self.known if message.header.stamp - known.seen > _FORGET_AFTER])
        self.labels.show({known.name: (known.reason, np.array(known.at)) for known in self.known}, self.stage.view())

    @property
    def reasons(self) -> list[str]:
        """The reasons that are shown, oldest first."""
        return [known.reason for known in self.known]

    def _add(self, m: Rejections) -> None:
        """Add these; one at a known place replaces it."""
        for each in m.rejected:
            at = (each.position.x, each.position.y, each.position.z)
            self._drop([known for known in self.known if _near(known.at, [at])])
            self._drop(self.known[: max(0, len(self.known) - _MOST + 1)])
            stamp = m.header.stamp
            self._count += 1
            ring_node = self.scene.add_mesh_simple(
                f"{self.root}/{self._count}_ring", *self._ring, color=REJECTED, position=at, **FLAT)
            self.known.append(_Known(at, each.reason, stamp, stamp, str(self._count), ring_node))

    def _drop(self, gone: list[_Known]) -> None:
        for known in gone:
            self.known.remove(known)
            known.node.remove()


def _near(at: Position, places: list[Position]) -> bool:
    return any(math.dist(at, place) < _SAME_PLACE for place in places)


class Workspace(Layer):
    """The reachable shell and the excluded column."""

    LABEL = "Workspace"
    TOPICS = (WORKSPACE_MARKERS,)

    def build(self) -> None:
        """Start without them."""
        self.markers = Markers(self.scene, self.root)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show these shapes and no others."""
        self.markers.show(message)
