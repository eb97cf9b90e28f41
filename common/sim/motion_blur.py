"""Where everything was within an exposure, from what is known of how it moves now."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from common.messages import JointState, Vector3, WorldObject, WorldObjects

Array = npt.NDArray[np.float64]

OLDEST = 0.1  # [s] after which what was told of a thing says nothing about how it moves
LONGEST = 0.25  # [s] between two pictures that tell how fast a thing moves
FASTEST = 5.0  # [m/s]: what went farther was put elsewhere


class Movement:
    """How objects move, by the last two times that it was told where they are."""

    def __init__(self) -> None:
        """Nothing has moved yet."""
        self._last: WorldObjects | None = None
        self._velocities: dict[str, Array] = {}

    def take(self, truth: WorldObjects) -> None:
        """Look at where objects are now."""
        before, self._last = self._last, truth
        if before is truth or before is None:
            return
        seconds = (truth.header.stamp - before.header.stamp) * 1e-9
        self._velocities = {}
        if not 0 < seconds <= LONGEST:
            return
        places = {thing.id: thing.pose.position for thing in before.objects}
        for thing in truth.objects:
            if (was := places.get(thing.id)) is not None and was != thing.pose.position:
                velocity = (_array(thing.pose.position) - _array(was)) / seconds
                if np.linalg.norm(velocity) < FASTEST:
                    self._velocities[thing.id] = velocity

    def objects(self, ago: float, now: int) -> Sequence[WorldObject]:
        """Where they were some time before it was last told [s]; now is a stamp [ns]."""
        if self._last is None:
            return []
        if ago == 0 or not self._velocities or (now - self._last.header.stamp) * 1e-9 > OLDEST:
            return self._last.objects
        return [self._moved(thing, ago) for thing in self._last.objects]

    def _moved(self, thing: WorldObject, ago: float) -> WorldObject:
        velocity = self._velocities.get(thing.id)
        if velocity is None:
            return thing
        x, y, z = (_array(thing.pose.position) - ago * velocity).tolist()
        return thing.model_copy(update={"pose": thing.pose.model_copy(update={"position": Vector3(x=x, y=y, z=z)})})


def joints_before(state: JointState | None, ago: float) -> JointState | None:
    """A state of joints as it was some time ago [s], by its velocities."""
    if state is None or ago == 0 or not any(state.velocity):
        return state
    position = [q - ago * dq for q, dq in zip(state.position, state.velocity, strict=True)]
    return state.model_copy(update={"position": position})


def times(exposure: float, count: int) -> Iterator[float]:
    """How long before the end of an exposure [s] each of so many pictures of it was; a single one is of the end."""
    for number in range(count):
        yield 0.0 if count == 1 else exposure * (count - 1 - number) / (count - 1)


def _array(point: Vector3) -> Array:
    return np.array([point.x, point.y, point.z])
