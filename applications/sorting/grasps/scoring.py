"""The geometric score of grasp candidates, and their order."""

from __future__ import annotations

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
    """Shares of the parts of the score; each part is from 0 to 1, and the score is their weighted mean.

    Fitted by logistic regression to 1361 attempts of a floating Panda hand at single objects and heaps of 8, of kinds
    for training (20 N, friction 0.2 to 0.6, pose error 3 mm and 3 degrees): area under the curve 0.81 in scenes that
    were left out, 0.71 with equal shares by hand. Slack had no share there; an arm among neighbors needs some.
    """

    engagement: float = 1.1
    center: float = 0.8
    alignment: float = 1.2
    slack: float = 0.3
    extent: float = 0.7
    evenness: float = 0.5
    upright: float = 0.6
    purity: float = 2.0
    narrow: float = 1.1


@dataclass(frozen=True)
class Scales:
    """Values of features at which a part of the score is full, or 0."""

    engagement: float = 0.02  # [m] full
    center: float = 0.03  # [m] 0
    alignment: float = 0.75  # cosine at which it is 0
    slack: float = 0.006  # [m] full
    roughness: float = 0.006  # [m] 0
    tilt: float = 0.7  # [rad] 0
    purity: float = 0.95  # 0
    width: float = 0.1  # [m] 0


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
        both = 0.75 * column["alignment"] + 0.25 * column["other_alignment"]
        full = {
            "engagement": column["engagement"] / s.engagement,
            "center": 1 - column["off_center"] / s.center,
            "alignment": (both - s.alignment) / (1 - s.alignment),
            "slack": column["slack"] / s.slack,
            "extent": column["extent"],
            "evenness": 1 - column["roughness"] / s.roughness,
            "upright": 1 - column["tilt"] / s.tilt,
            "purity": (column["purity"] - s.purity) / (1 - s.purity),
            "narrow": 1 - column["width"] / s.width,
        }
        return {name: np.clip(value, 0.0, 1.0) for name, value in full.items()}

    def score(self, features: Array) -> Array:
        """Return (n,) scores from 0 to 1."""
        parts = self.parts(features)
        shares = {each.name: float(getattr(self.weights, each.name)) for each in fields(self.weights)}
        total = sum(shares.values())
        return np.asarray(sum((shares[name] * parts[name] for name in shares), np.zeros(len(features))) / total)
