"""Frames of tf: the newest pose of any frame in any other, and where moving frames were in the last seconds."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from common.errors import UnknownName, ZencellError
from common.messages import TFMessage, TransformStamped
from common.robot.transforms import invert, pose_to_matrix, quaternion_to_matrix, transform

Array = NDArray[np.float64]

WORLD = "world"
HISTORY_SIZE = 250  # transforms of each frame: five seconds at 50 Hz
MAX_FRAMES = 2000  # stored, the newest ones: a faulty client could publish any number of frames
MAX_GAP = 0.1  # [s] between two transforms of a moving frame for a linear interpolation
MAX_LATE = 10.0  # [s] that a transform may be late; if it is later, the one before it had a stamp in the future
STILL = 1e-4  # [m], and of a quaternion: a frame that moved by less is at rest, and any gap is accepted


class NotConnected(ZencellError):
    """Two frames with different roots: the pose of one in the other is unknown."""

    def __init__(self, target: str, target_root: str, source: str, source_root: str) -> None:
        super().__init__(
            f"frames {target!r} and {source!r} are not connected: the root of one is {target_root!r}, of the other "
            f"{source_root!r}"
        )
        self.target = target
        self.source = source


class TransformTree:
    """Frames and the newest pose of each in its parent frame."""

    def __init__(self) -> None:
        """Start without any frame."""
        self._edges: dict[str, tuple[str, Array, int]] = {}  # by child: parent, T_parent_child, stamp [ns]

    def update(self, message: TFMessage) -> None:
        """Store transforms, except those slightly older than the stored one of their child.

        Above the limit of frames, those that were updated longest ago are dropped.
        """
        for each in message.transforms:
            self.set(each.header.frame_id, each.child_frame_id, pose_to_matrix(each.transform), each.header.stamp)
        for name in [*self._edges][: max(0, len(self._edges) - MAX_FRAMES)]:
            del self._edges[name]

    def set(self, parent: str, child: str, T_parent_child: Array, stamp: int = 0) -> None:
        """Set the pose of a frame in its parent.

        Args:
            parent: replaces any other parent of the child.
            child: a frame.
            T_parent_child: (4, 4), lengths in [m].
            stamp: time [ns]; an older transform than the stored one is ignored, unless it is so much older that the
                stored stamp must have been in the future.
        """
        known = self._edges.pop(child, None)
        late = known is not None and known[0] == parent and 0 < known[2] - stamp <= MAX_LATE * 1e9
        self._edges[child] = known if known is not None and late else (parent, T_parent_child, stamp)

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted({*self._edges, *(parent for parent, _, _ in self._edges.values())})

    def parent_of(self, frame: str) -> str | None:
        """Return the parent of a frame; None for a root."""
        edge = self._edges.get(frame)
        return edge[0] if edge else None

    def stamp_of(self, frame: str) -> int:
        """Return the time of the frame's pose in its parent [ns]; 0 for a root."""
        edge = self._edges.get(frame)
        return edge[2] if edge else 0

    def children_of(self, frame: str | None) -> list[str]:
        """Return the children of a frame, sorted; for None the roots."""
        if frame is None:
            return [name for name in self.frames if name not in self._edges]
        return sorted(child for child, (parent, _, _) in self._edges.items() if parent == frame)

    def walk(self) -> Iterator[tuple[int, str]]:
        """Yield depth and name of each frame, each root followed by its descendants."""
        waiting = deque((0, root) for root in self.children_of(None))
        while waiting:
            depth, frame = waiting.popleft()
            yield depth, frame
            waiting.extendleft((depth + 1, child) for child in reversed(self.children_of(frame)))

    def path(self, target: str, source: str) -> list[str]:
        """Return the frames from target to source, both included, by the fewest edges: breadth first over the tree.

        Raises:
            UnknownName: with the known frames.
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
        """Return (4, 4) T_target_source: the pose of source in target.

        Raises:
            UnknownName: with the known frames.
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


class TransformUnavailable(ZencellError):
    """The pose of a frame at a time is unknown.

    `kind`: unknown_frame; early: may still be published; unknown_camera: before the first transform; late: no longer
    stored; gap.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class TransformHistory:
    """Transforms of tf by time, so that an image gets the pose that its camera had at its stamp."""

    def __init__(self) -> None:
        """Start without any frame."""
        self._history: dict[str, deque[TransformStamped]] = {}  # by child, in the order of the last update

    def add(self, message: TFMessage) -> None:
        """Store transforms, except those that are not newer than the last one of their child.

        A much older one replaces the history of its child: a stamp in the future must not block updates until then.
        """
        for each in message.transforms:
            history = self._history.pop(each.child_frame_id, deque(maxlen=HISTORY_SIZE))
            self._history[each.child_frame_id] = history
            if history and history[-1].header.stamp - each.header.stamp > MAX_LATE * 1e9:
                history.clear()
            if not history or each.header.stamp > history[-1].header.stamp:
                history.append(each)
        for name in [*self._history][: max(0, len(self._history) - MAX_FRAMES)]:
            del self._history[name]

    @property
    def frame_count(self) -> int:
        """Number of stored frames."""
        return len(self._history)

    def pose(self, frame: str, fixed: TFMessage, stamp: int) -> Array:
        """Return (4, 4) T_world_frame at a time [ns], by fixed frames and, where these end, those of tf.

        Raises:
            TransformUnavailable: with the missing frame or time.
        """
        fixed_frames = {each.child_frame_id: each for each in fixed.transforms}
        T, at = np.eye(4), frame
        for _ in range(len(fixed_frames) + len(self._history) + 1):
            if at in ("", WORLD):
                return T
            if at in fixed_frames:
                T, at = pose_to_matrix(fixed_frames[at].transform) @ T, fixed_frames[at].header.frame_id
            elif at in self._history:
                T, at = self._between(at, stamp) @ T, self._history[at][-1].header.frame_id
            elif at == frame:
                raise TransformUnavailable("unknown_frame", f"tf_static has no frame {frame!r}; its frames: "
                                                   f"{', '.join(fixed_frames) or 'none'}")
            else:
                raise TransformUnavailable("early", f"tf has no pose yet of {at!r}, an ancestor of {frame!r}")
        raise TransformUnavailable("unknown_frame", f"frame {frame!r} is its own ancestor")

    def _between(self, frame: str, stamp: int) -> Array:
        """Return (4, 4) T_parent_frame at a time, interpolated between the transforms before and after it."""
        history = self._history[frame]
        if stamp > history[-1].header.stamp:
            raise TransformUnavailable("early", f"tf has no pose of {frame!r} at the time of the image yet")
        after = bisect_left(history, stamp, key=lambda each: each.header.stamp)
        b = history[after]
        if b.header.stamp == stamp:
            return pose_to_matrix(b.transform)
        if not after:
            began = len(history) < HISTORY_SIZE  # usual at the start
            raise TransformUnavailable("unknown_camera" if began else "late",
                              f"the image is older than the first pose of {frame!r} in tf")
        a = history[after - 1]
        (p, x), (q, y) = _parts(a), _parts(b)
        if x @ y < 0:
            y = -y  # the same rotation, by the shorter turn
        seconds = (b.header.stamp - a.header.stamp) * 1e-9
        if seconds > MAX_GAP and max(np.abs(p - q).max(), np.abs(x - y).max()) > STILL:
            raise TransformUnavailable("gap", f"{frame!r} moved during {seconds:.2f} s without a pose in tf")
        share = (stamp - a.header.stamp) / (b.header.stamp - a.header.stamp)
        turn = quaternion_to_matrix(*(x + share * (y - x)))  # close together: linear interpolation is exact enough
        return transform(turn, p + share * (q - p))


def _parts(each: TransformStamped) -> tuple[Array, Array]:
    """Return position (3,) [m] and quaternion (4,) x, y, z, w."""
    p, o = each.transform.position, each.transform.orientation
    return np.array([p.x, p.y, p.z]), np.array([o.x, o.y, o.z, o.w])
