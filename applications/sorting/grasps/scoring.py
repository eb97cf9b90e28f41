"""The geometric score of grasp candidates, and their order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FEATURES = (
    "engagement",  # [m] of the finger tips below the lower one of the two edges
    "off_center",  # [m] between the line of the contacts and the object's middle
    "alignment",  # cosine between closing axis and edge, the worse of the two
    "other_alignment",  # the better of the two
    "slack",  # [m] by which everything else could be wider and the open fingers would be free
    "tilt",  # [rad] of the tool from straight down
    "spare",  # [m] opening minus width
    "width",  # [m] between the contacts
    "tip_height",  # [m] of the tips above the floor
    "extent",  # fraction of the finger tips' width that meets the object
    "roughness",  # [m] how unevenly the edges meet the finger tips
    "purity",  # fraction of what is between the fingers that is the object
)


@dataclass(frozen=True)
class Weights:
    """Shares of the parts of the score; each part is from 0 to 1, and the score is their weighted mean."""

    engagement: float = 3.0
    center: float = 2.0
    alignment: float = 2.0
    slack: float = 1.0
    extent: float = 1.0
    evenness: float = 0.5
    upright: float = 0.5
    purity: float = 1.0


@dataclass(frozen=True)
class Scales:
    """Values of features at which a part of the score is full, or 0."""

    engagement: float = 0.025  # [m] full
    center: float = 0.03  # [m] 0
    alignment: float = 0.8  # cosine at which it is 0
    slack: float = 0.006  # [m] full
    roughness: float = 0.005  # [m] 0
    tilt: float = 0.7  # [rad] 0


class Scorer(Protocol):
    """Scores grasps from 0 to 1, the larger the better."""

    @property
    def name(self) -> str:
        """How it is called in messages."""

    def parts(self, features: Array) -> dict[str, Array]:
        """Return what the score consists of, each (n,), of features (n, k)."""

    def score(self, features: Array) -> Array:
        """Return (n,) scores of features (n, k), in the order of FEATURES."""


@dataclass(frozen=True)
class GeometricScorer:
    """A weighted mean of parts."""

    weights: Weights = Weights()
    scales: Scales = Scales()
    name: str = "geometric"

    def parts(self, features: Array) -> dict[str, Array]:
        """Return the parts, each (n,) from 0 to 1."""
        column = {name: features[:, k] for k, name in enumerate(FEATURES)}
        s = self.scales
        both = (column["alignment"] + column["other_alignment"]) / 2
        full = {
            "engagement": column["engagement"] / s.engagement,
            "center": 1 - column["off_center"] / s.center,
            "alignment": (0.5 * (column["alignment"] + both) - s.alignment) / (1 - s.alignment),
            "slack": column["slack"] / s.slack,
            "extent": column["extent"],
            "evenness": 1 - column["roughness"] / s.roughness,
            "upright": 1 - column["tilt"] / s.tilt,
            "purity": column["purity"],
        }
        return {name: np.clip(value, 0.0, 1.0) for name, value in full.items()}

    def score(self, features: Array) -> Array:
        """Return (n,) scores from 0 to 1."""
        parts = self.parts(features)
        shares = {each.name: float(getattr(self.weights, each.name)) for each in fields(self.weights)}
        total = sum(shares.values())
        return np.asarray(sum((shares[name] * parts[name] for name in shares), np.zeros(len(features))) / total)


@dataclass(frozen=True)
class Penalty:
    """A place where a grasp failed: near it, about along the same axis, grasps rank lower until a time.

    Attributes:
        position: (x, y, z) of the TCP [m], world.
        axis: (x, y, z) unit vector along which the fingers closed; its sign does not matter.
        until: monotonic time [s]; amount: of the score at the place itself.
    """

    position: tuple[float, float, float]
    axis: tuple[float, float, float]
    until: float
    amount: float = 0.5


NEAR = 0.02  # [m] from a failed place
ALIKE = np.deg2rad(30.0)  # [rad] between closing axes


def penalized(score: Array, position: Array, axis: Array, penalties: Sequence[Penalty], now: float) -> Array:
    """Return (n,) scores less penalties for failed places.

    Args:
        score: (n,).
        position: (n, 3) of the TCP [m]; axis: (n, 3) unit vectors along which the fingers close; both in world.
        penalties: those whose time is over do not count.
        now: monotonic time [s].
    """
    result = score.astype(float).copy()
    for penalty in penalties:
        if penalty.until <= now:
            continue
        away = np.linalg.norm(position - np.array(penalty.position), axis=1)
        turned = np.arccos(np.clip(np.abs(axis @ np.array(penalty.axis)), 0.0, 1.0))
        result -= penalty.amount * ((away <= NEAR) & (turned <= ALIKE))
    return result
