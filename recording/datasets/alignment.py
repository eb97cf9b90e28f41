"""Choice of the recorded sample for each frame of a data set, by stamp; and how far it is from the frame's time.

The times of frames are a grid: frame k is at `start + k / fps`, exactly. Nothing moves it. For each frame and stream
the sample with the nearest stamp is chosen if it is within half a period. Otherwise the frame is filled with the
newest sample before it, and counted. So a dropped image costs one filled frame, and later frames are not shifted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

SECOND = 1_000_000_000  # [ns]
Stamps = npt.NDArray[np.int64]  # [ns since the Unix epoch], ascending


@dataclass(frozen=True)
class Choice:
    """The sample of each frame, and its error."""

    index: npt.NDArray[np.int64]  # (frames,) into the stamps
    error_ns: npt.NDArray[np.int64]  # (frames,) stamp of the sample less time of the frame [ns]
    filled: npt.NDArray[np.bool_]  # (frames,) whether no sample was within half a period
    unused: int  # samples between the first and the last frame that no frame has


def grid(start: int, end: int, fps: int) -> Stamps:
    """Return the times of frames from `start` to `end` at most [ns]."""
    count = (end - start) * fps // SECOND + 1
    return np.array([start + k * SECOND // fps for k in range(count)], np.int64)


def phase(stamps: Stamps, fps: int) -> int:
    """Return by how much a grid starts later than the first stamp to be nearest to all of them [ns].

    The mean of their phases on a circle: one late first exposure does not put all others off.
    """
    gaps = np.diff(stamps)
    period = min(SECOND / fps, float(np.median(gaps))) if len(gaps) else SECOND / fps
    angles = (stamps - stamps[0]) % period * (2 * np.pi / period)
    return round(float(np.angle(np.exp(1j * angles).mean())) * period / (2 * np.pi))


def nearest(stamps: Stamps, times: Stamps, fps: int) -> Choice:
    """Return the choice for a stream whose first stamp is at most half a period after the first time."""
    after = np.searchsorted(stamps, times, side="right")
    before = np.maximum(after - 1, 0)  # newest at or before the time
    following = np.minimum(after, len(stamps) - 1)
    late = np.abs(stamps[following] - times) < np.abs(times - stamps[before])
    index = np.where(late, following, before)
    filled = 2 * fps * np.abs(stamps[index] - times) > SECOND
    index = np.where(filled, before, index)
    inside = (stamps >= times[0]) & (stamps <= times[-1])
    unused = int(inside.sum() - inside[np.unique(index)].sum())
    return Choice(index, stamps[index] - times, filled, unused)


def in_force(stamps: Stamps, times: Stamps) -> Choice:
    """Return the choice for a state, whose newest value at or before a time is in force: its age is no error."""
    index = np.maximum(np.searchsorted(stamps, times, side="right") - 1, 0)
    none = np.zeros(len(times), np.int64)
    return Choice(index, none, none.astype(np.bool_), 0)
