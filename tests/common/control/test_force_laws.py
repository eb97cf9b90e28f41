"""The laws of force motions against a model of a hole, without an arm."""

import re
from typing import Any

import numpy as np
import pytest

from common.control.force_laws import Sample, law_of
from common.control.goals import Outcome
from common.messages import ForceMotion, JointTrajectory

DT = 0.01  # [s]
STIFFNESS = 2e4  # [N/m]


def request(kind: str, **fields: Any) -> ForceMotion:
    line = JointTrajectory(joint_names=["joint"], points=[])
    return ForceMotion.model_validate({"id": "a", "kind": kind, "trajectory": line, **fields})


class Hole:
    """A surface with a hole of a capture radius at an offset across; the part is the point that the law moves."""

    def __init__(self, at: tuple[float, float], surface: float = 0.01, capture: float = 3e-4, bottom: float = 0.03,
                 stuck: float = 1.0) -> None:
        self.at, self.surface, self.capture, self.bottom = np.array(at), surface, capture, surface + bottom
        self.stuck = surface + stuck
        self.inside = False

    def measure(self, time: float, x: np.ndarray) -> Sample:
        aside = float(np.linalg.norm(x[:2] - self.at))
        self.inside = aside < self.capture or (self.inside and x[2] > self.surface + 1e-3)
        ground = min(self.bottom, self.stuck) if self.inside else self.surface
        deep = max(x[2] - ground, 0.0)
        wrench = np.array([0.0, 0.0, -STIFFNESS * deep, 0.0, 0.0, 0.0])
        if self.inside and x[2] > self.surface:
            wrench[:2] = -STIFFNESS * (x[:2] - self.at)
        measured = x.copy()
        measured[2] = min(x[2], ground)
        return Sample(time, x.copy(), measured, wrench, wrench)


def follow(law: Any, hole: Hole, seconds: float = 120.0) -> tuple[Outcome, np.ndarray, float]:
    """The end, the offset there, and the largest speed."""
    x, fastest = np.zeros(6), 0.0
    for k in range(round(seconds / DT)):
        decided = law.velocity(hole.measure(k * DT, x), DT)
        if isinstance(decided, Outcome):
            return decided, x, fastest
        fastest = max(fastest, float(np.linalg.norm(decided[:3])))
        x = x + decided * DT
    raise AssertionError("the law does not end")


@pytest.mark.parametrize("at", [(0.0, 0.0), (1e-3, 0.0), (-0.7e-3, 0.7e-3), (0.0, -2.5e-3)])
def test_insertion_finds_the_hole_and_goes_to_the_depth(at: tuple[float, float]) -> None:
    law = law_of(request("insert", depth=0.015, max_distance=0.05, timeout=100.0, surface=0.01))
    outcome, x, fastest = follow(law, Hole(at))
    assert outcome.state == "succeeded", outcome
    assert x[2] >= 0.025 and np.linalg.norm(x[:2] - at) < 5e-4 and fastest < 0.025


@pytest.mark.parametrize(("hole", "fields", "message"), [
    (Hole((8e-3, 0.0)), {"radius": 0.001, "timeout": 300.0}, "in 8 searches: .* in the search"),
    (Hole((8e-3, 0.0)), {"timeout": 5.0}, "within 5 s"),
    (Hole((0.0, 0.0), stuck=0.004), {"timeout": 300.0, "surface": 0.01}, "in 8 searches: 4.00 of 15 mm deep"),
    (Hole((0.0, 0.0), surface=1.0), {}, "within 50 mm: no contact, in the approach"),
])
def test_insertion_that_fails_says_how_far_it_came(hole: Hole, fields: dict[str, Any], message: str) -> None:
    outcome, _, _ = follow(law_of(request("insert", depth=0.015, max_distance=0.05, **fields)), hole, 400.0)
    assert (outcome.state, outcome.error) == ("aborted", "not_inserted")
    assert re.search(message, outcome.message), outcome.message


def test_admittance_is_stable_for_a_light_mass_and_a_long_step() -> None:
    law = law_of(request("comply", mass=0.001, damping=100.0, force=0.0))
    push = np.array([10.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(50):
        v = law.velocity(Sample(0.0, np.zeros(6), np.zeros(6), push, push), 0.05)
        assert isinstance(v, np.ndarray) and 0.0 <= v[0] <= 0.01 + 1e-9 and not v[1:].any()


def test_admittance_ignores_noise_and_blocked_axes() -> None:
    law = law_of(request("comply", force=0.0, across=False))
    noise, push = np.full(6, 0.04), np.array([20.0, 20.0, 0.0, 3.0, 3.0, 3.0])
    for wrench in (noise, push):
        v = law.velocity(Sample(0.0, np.zeros(6), np.zeros(6), wrench, wrench), DT)
        assert isinstance(v, np.ndarray) and not v.any()


@pytest.mark.parametrize(("fields", "problem"), [
    ({"direction": {"x": 0.0, "y": 0.0, "z": 0.5}}, "direction has length 0.5, it must be 1"),
    ({"kind": "until", "force": 0.0}, "until needs a force above 0"),
    ({"kind": "insert", "depth": 0.06}, "depth 0.06 must be less than max_distance 0.05"),
    ({"joins": "b"}, "leave joins empty"),
    ({"speed": 0.2}, "less than or equal to 0.1"),
])
def test_invalid_request_names_the_value(fields: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        request(**{"kind": "comply", **fields})
