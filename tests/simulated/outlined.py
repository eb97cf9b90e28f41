"""Checks of the figures of a run whose outline was traced well."""

from typing import Any

import pytest


def assert_good(summary: dict[str, Any]) -> None:
    outline = summary["outline"]
    assert summary["state"] == "DONE"
    assert outline["fraction"] == 1.0 and outline["closed"]
    assert outline["deviation_mm"]["max"] < 0.5 and outline["deviation_mm"]["mean"] < 0.2
    assert outline["tracking_mm"]["max"] < 0.15
    assert summary["failures"] == 0


def assert_cube_outlined(summary: dict[str, Any]) -> None:
    """Check every figure of an uninterrupted outline of the world w2."""
    assert_good(summary)
    outline = summary["outline"]
    assert set(outline) == {"object", "points", "fraction", "length_m", "closed", "deviation_mm", "tracking_mm"}
    assert outline["length_m"] == pytest.approx(0.4, abs=0.002)
    assert 4 <= outline["points"] < 1000
    assert [plan["fraction"] for plan in summary["plans"]] == [1.0] * 5, "one for each stage, none repeated"
    assert summary["restarts"] == {}
