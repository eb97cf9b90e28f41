"""Policies that are broken or mean harm never move the arm into anything, nor beyond its limits."""

from __future__ import annotations

import pytest

from common.control.limiter import SLACK
from tests.applications.policy.hostile_cell import run_hostile


@pytest.mark.parametrize("seed", [2, 4, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(5, 45))])
def test_hostile_chunks_touch_nothing_and_break_no_limit(seed: int) -> None:
    verdict = run_hostile(seed, 10)
    assert verdict.sequences >= 9 and verdict.chunks["chunks"] > 10 and verdict.checked > 1000, verdict
    assert (verdict.contacts, verdict.broken, verdict.crashes) == (0, [], []), verdict
    assert verdict.most["position"] <= 1.001 and verdict.most["deceleration"] <= 1 + SLACK, verdict
    assert max(verdict.most["velocity"], verdict.most["jerk"]) <= 1 + SLACK, verdict
