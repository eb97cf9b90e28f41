"""Where moving frames were in the last seconds, so that a picture gets the pose that its camera had at its instant."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np
from numpy.typing import NDArray

from common.errors import ZencellError
from common.messages import TFMessage, TransformStamped
from common.robot.transforms import pose_to_matrix, quaternion_to_matrix, transform

Array = NDArray[np.float64]

WORLD = "world"
KEPT = 250  # transforms of each frame: five seconds at 50 Hz
MOST_FRAMES = 2000  # of which something is kept, those told of last: whoever is on the network can make any number up
APART = 0.1  # [s] two transforms may be apart for what lies between to be a straight line
AHEAD = 10.0  # [s] that a transform may be older than one before it: else that one said a time that is yet to come
RESTS = 1e-4  # [m, and of a quaternion] a frame that has moved by less rests, and they may be apart for any time


class NoTransform(ZencellError):
    """It is not known where a frame was.

    `kind`: unknown_frame; early, and may still be told; unknown_camera, at a time before all that was told; late, when
    that is forgotten; gap.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class TransformHistory:
    """The transforms of tf by their time."""

    def __init__(self) -> None:
        """Know no frame."""
        self._kept: dict[str, deque[TransformStamped]] = {}  # by child, in the order in which they were told of

    def note(self, message: TFMessage) -> None:
        """Take over transforms; one that is not newer than what is known of its child is left out.

        Where it is much older, what is known is left out: a stamp of a time to come must not hide all until then.
        """
        for each in message.transforms:
            kept = self._kept.pop(each.child_frame_id, deque(maxlen=KEPT))
            self._kept[each.child_frame_id] = kept
            if kept and kept[-1].header.stamp - each.header.stamp > AHEAD * 1e9:
                kept.clear()
            if not kept or each.header.stamp > kept[-1].header.stamp:
                kept.append(each)
        for name in [*self._kept][: max(0, len(self._kept) - MOST_FRAMES)]:
            del self._kept[name]

    def pose(self, frame: str, fixed: TFMessage, stamp: int) -> Array:
        """(4, 4) T_world_frame at a time [ns], over frames that never move and, where these end, those of tf.

        Raises:
            NoTransform: with what is missing.
        """
        still = {each.child_frame_id: each for each in fixed.transforms}
        T, at = np.eye(4), frame
        for _ in range(len(still) + len(self._kept) + 1):
            if at in ("", WORLD):
                return T
            if at in still:
                T, at = pose_to_matrix(still[at].transform) @ T, still[at].header.frame_id
            elif at in self._kept:
                T, at = self._between(at, stamp) @ T, self._kept[at][-1].header.frame_id
            elif at == frame:
                raise NoTransform("unknown_frame", f"tf_static has no frame {frame!r}; it has: "
                                                   f"{', '.join(still) or 'none'}")
            else:
                raise NoTransform("early", f"tf does not say yet where {at!r} is, on which {frame!r} hangs")
        raise NoTransform("unknown_frame", f"frame {frame!r} hangs on itself")

    def _between(self, frame: str, stamp: int) -> Array:
        """(4, 4) T_parent_frame at a time, between the transforms before and after it."""
        kept = self._kept[frame]
        if stamp > kept[-1].header.stamp:
            raise NoTransform("early", f"tf does not say yet where {frame!r} is at the time of the picture")
        after = bisect_left(kept, stamp, key=lambda each: each.header.stamp)
        b = kept[after]
        if b.header.stamp == stamp:
            return pose_to_matrix(b.transform)
        if not after:
            began = len(kept) < KEPT  # usual in the first moments
            raise NoTransform("unknown_camera" if began else "late",
                              f"tf says only from later on where {frame!r} was than the picture was taken")
        a = kept[after - 1]
        (p, x), (q, y) = _parts(a), _parts(b)
        if x @ y < 0:
            y = -y  # the same turn, and the shorter way to it
        seconds = (b.header.stamp - a.header.stamp) * 1e-9
        if seconds > APART and max(np.abs(p - q).max(), np.abs(x - y).max()) > RESTS:
            raise NoTransform("gap", f"{frame!r} moved in {seconds:.2f} s of which tf says nothing")
        share = (stamp - a.header.stamp) / (b.header.stamp - a.header.stamp)
        turn = quaternion_to_matrix(*(x + share * (y - x)))  # so near each other that the straight line is as good
        return transform(turn, p + share * (q - p))


def _parts(each: TransformStamped) -> tuple[Array, Array]:
    """Position (3,) [m] and quaternion (4,) x, y, z, w."""
    p, o = each.transform.position, each.transform.orientation
    return np.array([p.x, p.y, p.z]), np.array([o.x, o.y, o.z, o.w])
