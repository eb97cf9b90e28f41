"""Position and velocity of an object from detections over time, on a belt with an encoder or without one.

On a belt the encoder measures how far the object has moved between two images, also when the belt changes its speed:
only where it lies on the belt is estimated from the images. Elsewhere a line is fitted through the newest positions.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from common.config import Conveyor
from common.messages import ConveyorState

Array = NDArray[np.float64]
Place = tuple[float, float, float]

WINDOW = 1.0  # [s] of detections that count
LEAST, LEAST_TIME = 3, 0.15  # detections and the time between first and last [s] for a velocity
STILL = 0.01  # [m/s] a slower object lies still
SLIPPED = 0.012  # [m] from the expected position: the object was moved, and former detections do not count
HISTORY = 3.0  # [s] of encoder readings


class Encoders:
    """The newest readings of the encoders of all belts."""

    def __init__(self, conveyors: Mapping[str, Conveyor]) -> None:
        """Start without a reading."""
        self.conveyors = conveyors
        self._readings: deque[tuple[float, dict[str, tuple[float, float]]]] = deque()

    def add(self, state: ConveyorState) -> None:
        """Take a reading."""
        now = state.header.stamp * 1e-9
        if self._readings and now <= self._readings[-1][0]:
            return
        self._readings.append((now, {belt.name: (belt.position, belt.speed) for belt in state.belts}))
        while now - self._readings[0][0] > HISTORY:
            self._readings.popleft()

    def below(self, place: Place, height: float) -> str:
        """Return the belt on which an object of a height [m] with its centre there lies; empty for none."""
        x, y, z = place
        return next((name for name, belt in self.conveyors.items() if belt.carries(x, y, z - height / 2, 0.02)), "")

    def at(self, name: str, time: float) -> tuple[float, float] | None:
        """Return position [m] and speed [m/s] of a belt at a time [s], also after the newest reading; or None."""
        known = [(at, belts[name]) for at, belts in self._readings if name in belts]
        if not known:
            return None
        after = next((index for index, (at, _) in enumerate(known) if at > time), len(known))
        at, (position, speed) = known[max(after - 1, 0)]
        if 0 < after < len(known):
            following, (ahead, _) = known[after]
            return position + (ahead - position) * (time - at) / (following - at), speed
        return position + speed * (time - at), speed


class MovingEstimate:
    """Where one object is and how it moves."""

    def __init__(self, encoders: Encoders) -> None:
        """Start without a detection."""
        self._encoders = encoders
        self._seen: deque[tuple[float, Array]] = deque()
        self._belt = ""

    def add(self, time: float, place: Place, height: float) -> None:
        """Take a detection: its time [s], centre and height [m]."""
        belt = self._encoders.below(place, height)
        expected = self.at(time)
        if belt != self._belt or (len(self._seen) >= LEAST and np.linalg.norm(expected[0] - place) > SLIPPED):
            self._seen.clear()
        self._belt = belt
        self._seen.append((time, np.array(place)))
        while time - self._seen[0][0] > WINDOW:
            self._seen.popleft()

    def at(self, time: float) -> tuple[Array, Array]:
        """Return position [m] and velocity [m/s] (3,) at a time [s]; before the first detection zeros."""
        if not self._seen:
            return np.zeros(3), np.zeros(3)
        times, places = np.array([t for t, _ in self._seen]), np.array([place for _, place in self._seen])
        if (belt := self._encoders.at(self._belt, time)) is not None:
            along = np.array([*self._encoders.conveyors[self._belt].direction, 0.0])
            ways = [(self._encoders.at(self._belt, float(t)) or belt)[0] for t in times]
            base = (places - np.outer(ways, along)).mean(axis=0)
            return base + belt[0] * along, (belt[1] if abs(belt[1]) > 1e-4 else 0.0) * along
        if len(times) < LEAST or times[-1] - times[0] < LEAST_TIME:
            return places[-1], np.zeros(3)
        centred = times - times.mean()
        velocity = centred @ (places - places.mean(axis=0)) / (centred @ centred)
        if float(np.linalg.norm(velocity)) < STILL:
            return places[-1], np.zeros(3)
        return places.mean(axis=0) + (time - times.mean()) * velocity, velocity
