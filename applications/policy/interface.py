"""What a policy receives and returns, and what the proof of a chunk takes and gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
ChunkKind = Literal["joints", "joint_steps", "tcp", "tcp_steps"]


@dataclass(frozen=True)
class Observation:
    """State of the cell at one time, resampled by stamps.

    Attributes:
        stamp: exposure of the images [ns, cell time]; all values are of this time.
        positions: (dof,) [rad].
        velocities: (dof,) [rad/s].
        tcp: T_world_tcp (4, 4) [m].
        gripper: width [m]; 0 without a gripper.
        images: RGB (h, w, 3) uint8 by the name of the camera.
        instruction: what to do, in words.
        committed: joint targets (k, dof) [rad] at the chunk rate after `stamp`, which the arm reaches whatever the
            policy returns; a new chunk takes effect after them.
    """

    stamp: int
    positions: Vector
    velocities: Vector
    tcp: NDArray[np.float64]
    gripper: float
    images: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    instruction: str = ""
    committed: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True)
class Chunk:
    """Actions of a policy. Row i is the target for the time `stamp + (i + 1) / rate`.

    Attributes:
        stamp: of the observation that it answers [ns, cell time].
        rate: of the rows [Hz].
        kind: `joints`: (n, dof) [rad]. `joint_steps`: (n, dof) [rad] added to the positions of the observation.
            `tcp`: (n, 7) T_world_tcp as x, y, z [m] and quaternion x, y, z, w. `tcp_steps`: (n, 6) translation [m] and
            rotation vector [rad] along the axes of world, relative to the pose of the observation.
        values: as `kind` says; may hold anything that a policy can return, NaN too.
        gripper: widths (n,) [m], or None.
    """

    stamp: int
    rate: float
    kind: ChunkKind
    values: NDArray[np.float64]
    gripper: NDArray[np.float64] | None = None


class PolicySource(Protocol):
    """Where chunks come from: an ONNX file, a function of the user's, a server."""

    async def infer(self, observation: Observation) -> Chunk:
        """Return the next actions.

        Raises:
            PolicyFailed: there is none, with the reason.
        """

    async def close(self) -> None:
        """Release files and connections."""


class PolicyFailed(Exception):
    """A policy returned no actions, or actions of a wrong shape."""


@dataclass(frozen=True)
class MotionState:
    """Set-point of the arm where a new motion joins: (dof,) each [rad], [rad/s], [rad/s^2]."""

    positions: Vector
    velocities: Vector
    accelerations: Vector


Cause = Literal["shape", "not_finite", "jump", "position", "velocity", "acceleration", "jerk", "region", "collision",
                "stop"]


@dataclass(frozen=True)
class Violation:
    """Why a chunk, or its rest, is not executed.

    Attributes:
        cause: kind of the failed check.
        what: joint, pair of links, or side of the region.
        time: after the join [s] at which it would happen.
        message: one line for the operator.
    """

    cause: Cause
    what: str
    time: float
    message: str


@dataclass(frozen=True)
class ProvedMotion:
    """A motion that was proved as a whole, its end at rest included.

    Attributes:
        times: (m,) [s] after the join, increasing from 0.
        positions: (m, dof) [rad].
        velocities: (m, dof) [rad/s].
        accelerations: (m, dof) [rad/s^2].
        moving: time [s] until which it follows the chunk; braking to rest follows. 0: nothing of the chunk is executed.
        rows: number of rows of the chunk that it follows.
        slowed: factor >= 1 by which the chunk was slowed down to keep the limits.
        violation: why it does not follow the complete chunk; None if it does.
    """

    times: Vector
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    accelerations: NDArray[np.float64]
    moving: float
    rows: int
    slowed: float = 1.0
    violation: Violation | None = None
