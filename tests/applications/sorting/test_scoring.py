"""The geometric score of grasps."""

from __future__ import annotations

import numpy as np
import pytest

from applications.sorting.grasps.scoring import FEATURES, GeometricScorer

GOOD = {
    "engagement": 0.015, "off_center": 0.005, "alignment": 0.9, "other_alignment": 0.95, "slack": 0.003, "tilt": 0.2,
    "spare": 0.014, "width": 0.04, "tip_height": 0.01, "extent": 0.8, "roughness": 0.002, "purity": 0.98,
}


def row(**changes: float) -> list[float]:
    return [{**GOOD, **changes}[name] for name in FEATURES]


@pytest.mark.parametrize("change", [
    {"engagement": 0.008}, {"off_center": 0.02}, {"alignment": 0.8}, {"other_alignment": 0.9}, {"slack": 0.0},
    {"tilt": 0.5}, {"width": 0.07}, {"extent": 0.4}, {"roughness": 0.005}, {"purity": 0.955},
], ids=lambda change: next(iter(change)))
def test_a_worse_feature_lowers_the_score(change: dict[str, float]) -> None:
    good, worse = GeometricScorer().score(np.array([row(), row(**change)]))
    assert worse < good


def test_scores_and_parts_are_from_0_to_1_for_any_features() -> None:
    features = np.random.default_rng(0).uniform(-2, 2, (500, len(FEATURES)))
    scorer = GeometricScorer()
    every = [scorer.score(features), *scorer.parts(features).values()]
    assert all(((values >= 0) & (values <= 1)).all() for values in every)
    assert np.ptp(every[0]) > 0.3
