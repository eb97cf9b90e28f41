"""A tree of frames: the pose of any frame in any other, along the edges between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from common.errors import UnknownName, ZencellError
from common.messages import TFMessage
from common.robot.transform_history import AHEAD, MOST_FRAMES
from common.robot.transforms import invert, pose_to_matrix

Array = NDArray[np.float64]


class NotConnected(ZencellError):
    """Two frames that hang on different roots: nothing says where one is in the other."""

    def __init__(self, target: str, target_root: str, source: str, source_root: str) -> None:
        super().__init__(
            f"frames {target!r} and {source!r} are not connected: one hangs on {target_root!r}, the other on "
            f"{source_root!r}"
        )
        self.target = target
        self.source = source


class TransformTree:
    """Frames and the newest pose of each in the frame that it hangs on."""

    def __init__(self) -> None:
        """Know no frame."""
        self._edges: dict[str, tuple[str, Array, int]] = {}  # by child: parent, T_parent_child, stamp [ns]

    def update(self, message: TFMessage) -> None:
        """Take over transforms; one that is a little older than what is known of its child is left out.

        Of too many frames those are forgotten that were told of longest ago.
        """
        for each in message.transforms:
            self.set(each.header.frame_id, each.child_frame_id, pose_to_matrix(each.transform), each.header.stamp)
        for name in [*self._edges][: max(0, len(self._edges) - MOST_FRAMES)]:
            del self._edges[name]

    def set(self, parent: str, child: str, T_parent_child: Array, stamp: int = 0) -> None:
        """Say where a frame is in another one.

        Args:
            parent: the frame that the child hangs on; a child that hung elsewhere moves over.
            child: has one parent.
            T_parent_child: (4, 4), lengths in [m].
            stamp: when [ns]; what is older than the transform that is known is left out, unless by so much that this
                one was of a time to come.
        """
        known = self._edges.pop(child, None)
        late = known is not None and known[0] == parent and 0 < known[2] - stamp <= AHEAD * 1e9
        self._edges[child] = known if known is not None and late else (parent, T_parent_child, stamp)

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted({*self._edges, *(parent for parent, _, _ in self._edges.values())})

    def parent_of(self, frame: str) -> str | None:
        """The frame that a frame hangs on; None for a root."""
        edge = self._edges.get(frame)
        return edge[0] if edge else None

    def stamp_of(self, frame: str) -> int:
        """When the frame's pose in its parent was true [ns]; 0 for a root."""
        edge = self._edges.get(frame)
        return edge[2] if edge else 0

    def children_of(self, frame: str | None) -> list[str]:
        """Frames that hang on a frame, sorted; for None the roots."""
        if frame is None:
            return [name for name in self.frames if name not in self._edges]
        return sorted(child for child, (parent, _, _) in self._edges.items() if parent == frame)

    def walk(self) -> Iterator[tuple[int, str]]:
        """Depth and name of each frame, every root first and then what hangs on it."""
        waiting = deque((0, root) for root in self.children_of(None))
        while waiting:
            depth, frame = waiting.popleft()
            yield depth, frame
            waiting.extendleft((depth + 1, child) for child in reversed(self.children_of(frame)))

    def path(self, target: str, source: str) -> list[str]:
        """The frames from target to source, both included, by the fewest edges: breadth first over the tree.

        Raises:
            UnknownName: with the frames that there are.
            NotConnected: no edges lead from one to the other.
        """
        frames = self.frames
        for frame in (target, source):
            if frame not in frames:
                raise UnknownName("frame", frame, frames)
        before: dict[str, str] = {target: target}
        waiting = deque([target])
        while waiting and source not in before:
            frame = waiting.popleft()
            parent = self.parent_of(frame)
            for near in [*([parent] if parent else []), *self.children_of(frame)]:
                if near not in before:
                    before[near] = frame
                    waiting.append(near)
        if source not in before:
            raise NotConnected(target, self._root_of(target), source, self._root_of(source))
        found = [source]
        while found[-1] != target:
            found.append(before[found[-1]])
        return found[::-1]

    def pose(self, target: str, source: str) -> Array:
        """(4, 4) T_target_source: the pose of source in target.

        Raises:
            UnknownName: with the frames that there are.
            NotConnected: no edges lead from one to the other.
        """
        T = np.eye(4)
        frames = self.path(target, source)
        for near, far in pairwise(frames):
            down = self.parent_of(far) == near
            T = T @ (self._edges[far][1] if down else invert(self._edges[near][1]))
        return T

    def _root_of(self, frame: str) -> str:
        seen = {frame}
        while (parent := self.parent_of(frame)) and parent not in seen:
            frame = parent
            seen.add(frame)
        return frame
