"""Scenes and tries repeat by their seed; the scorers are compared under the same conditions."""

from dataclasses import fields

import numpy as np
import pytest

pytest.importorskip("mujoco")

from applications.sorting.learning import data, evaluate, scenes
from applications.sorting.objects.kinds import draw

Rig = scenes.Rig


@pytest.fixture(scope="module")
def rig() -> Rig:
    return scenes.rig_of("sorting")


def test_tries_of_a_scene_repeat_by_seed_and_number(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data, "HEAPS", (1,))
    monkeypatch.setattr(data, "TRIES", {1: 3})
    first, again = (data.tries_of_scene(rig, 3, 1) for _ in range(2))
    assert first is not None and again is not None
    for each in fields(first):
        assert np.array_equal(getattr(first, each.name), getattr(again, each.name), equal_nan=each.name == "mass")
    assert first.numbers.shape == (3, len(data.NUMBERS)) and np.isfinite(first.numbers).all()


def test_camera_sees_the_object_where_it_lies(rig: Rig) -> None:
    rng = np.random.default_rng(2)
    bench = scenes.fallen(rig, [draw("block", rng)], rng)
    assert bench is not None
    seen = scenes.perceive(rig, bench, rng)
    at = bench.positions()[0]
    nearest = min(np.hypot(each.center.x - at[0], each.center.y - at[1]) for each in seen.objects)
    assert nearest < 0.01
    labeled = seen.surface.xy(*np.nonzero(seen.labels)).mean(axis=0)
    assert labeled == pytest.approx(at[:2], abs=0.01)


def test_heap_falls_into_the_tray_and_comes_to_rest(rig: Rig) -> None:
    rng = np.random.default_rng(4)
    bench = scenes.fallen(rig, [draw(kind, rng) for kind in ("block", "can", "bar", "washer")], rng)
    assert bench is not None and len(bench.positions()) == 4
    off = np.abs(bench.positions()[:, :2] - (rig.tray.x, rig.tray.y))
    assert (off < rig.tray.half_side).all()


def test_error_of_the_pose_has_the_given_length_and_angle() -> None:
    rng = np.random.default_rng(0)
    for factor in (0.0, 1.0, 2.5):
        T = scenes.draw_conditions(rng, 20.0, error=factor).error
        angle = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        assert np.linalg.norm(T[:3, 3]) == pytest.approx(factor * scenes.OFFSET)
        assert angle == pytest.approx(factor * scenes.TURN, abs=1e-4)


def test_scorers_that_agree_have_one_outcome(rig: Rig) -> None:
    job = evaluate.Job("sorting", (), None, 20.0, 1.0, 1, 0)
    geometric = evaluate.scorers(None)["geometric"]
    same = {"geometric": geometric, "copy": geometric}
    found = [evaluate.trial(rig, same, job, number, evaluate.source_of(None)) for number in range(3)]
    outcomes = [each.results for each in found if each is not None]
    assert outcomes and all(each["geometric"] == each["copy"] for each in outcomes)
    assert {result for each in outcomes for result in each.values()} <= {
        "held", "empty", "slipped", "two", "knocked out", "no candidate"}
