"""Figures of the paired test and of the card, the files of tries and networks, and the errors of bad ones."""

import json
from pathlib import Path

import numpy as np
import pytest

from applications.sorting.learning.card import auc, calibration
from applications.sorting.learning.network import MAX_BYTES, Network
from applications.sorting.learning.patches import SIZE, STEP
from applications.sorting.learning.train import Split, platt
from applications.sorting.learning.tries import Tries
from common.errors import ConfigError

pytest.importorskip("mujoco", reason="make setup EXTRAS=physics")
from applications.sorting.learning.evaluate import Trial, mcnemar, table, wilson  # noqa: E402


def tries(count: int = 40, seed: int = 0) -> Tries:
    rng = np.random.default_rng(seed)
    return Tries(
        patches=rng.normal(size=(count, SIZE, SIZE)).astype(np.float16),
        numbers=rng.normal(size=(count, 3)).astype("f4"),
        parts=rng.random((count, 2)).astype("f4"), score=rng.random(count).astype("f4"), held=rng.random(count) < 0.7,
        result=np.array(["held"] * count), scene=np.arange(count) // 4, count=np.ones(count, np.int64),
        friction=np.full(count, 0.4, "f4"), mass=np.full(count, 0.1, "f4"), names=np.array(["a", "b", "c"]),
        part_names=np.array(["p", "q"]))


def card(path: Path, **changes: object) -> Path:
    path.with_suffix(".json").write_text(
        json.dumps({"numbers": ["a", "b"], "patch": {"size": SIZE, "step": STEP}} | changes), encoding="utf-8")
    return path


# Reference values: Newcombe, "Two-sided confidence intervals for the single proportion" (1998), table I; McNemar by
# the binomial distribution.
@pytest.mark.parametrize("held, count, low, high", [
    (81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)])
def test_wilson_interval(held: int, count: int, low: float, high: float) -> None:
    assert wilson(held, count) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize("first, second, p", [
    (0, 0, 1.0), (5, 5, 1.0), (0, 5, 0.0625), (1, 8, 20 / 512), (10, 2, 2 * 79 / 4096)])
def test_mcnemar_is_exact_and_symmetric(first: int, second: int, p: float) -> None:
    assert mcnemar(first, second) == mcnemar(second, first) == pytest.approx(p)


def test_table_compares_scorers_in_pairs() -> None:
    trials = [Trial(k, "block", {"geometric": "held" if k < 6 else "slipped", "learned": "held" if k < 8 else "empty"})
              for k in range(10)]
    text = table(trials)
    assert "6 of 10" in text and "8 of 10" in text
    assert "learned held 2 that geometric did not, geometric 0 that learned did not: McNemar p = 0.5" in text
    assert "learned: 2 empty, 8 held" in text
    assert table([]) == "no scene came to rest"


def test_area_under_the_curve_counts_pairs_and_halves_ties() -> None:
    score = np.array([0.1, 0.4, 0.4, 0.9])
    held = np.array([False, True, False, True])
    assert auc(score, held) == pytest.approx((1 + 0.5 + 1 + 1) / 4)
    assert auc(score, np.ones(4, bool)) == 0.5


def test_calibration_and_scaling_of_logits_recover_the_true_probability() -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(size=20_000)
    held = rng.random(len(logits)) < 1 / (1 + np.exp(-(0.5 * logits + 1.0)))
    scale, shift = platt(logits, held)
    assert (scale, shift) == pytest.approx((0.5, 1.0), abs=0.05)
    for predicted, fraction, _ in calibration(scale * logits + shift, held):
        assert predicted == pytest.approx(fraction, abs=0.03)


def test_split_divides_no_scene() -> None:
    scene = np.repeat(np.arange(50), 4)
    split = Split.of(scene, 0)
    assert (split.train.astype(int) + split.check + split.test == 1).all()
    parts = [set(scene[mask]) for mask in (split.train, split.check, split.test)]
    assert [len(part) for part in parts] == [40, 5, 5] and not parts[0] & (parts[1] | parts[2])


def test_tries_are_the_same_after_saving_and_joining(tmp_path: Path) -> None:
    made = tries()
    made.save(tmp_path / "tries.npz")
    read = Tries.joined([Tries.read(tmp_path / "tries.npz"), tries(seed=1)])
    assert len(read) == 80 and (read.patches[:40] == made.patches).all() and read.names.tolist() == ["a", "b", "c"]


def test_unusable_files_of_tries_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("no array")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for name, expected in (("missing.npz", "cannot be read"), ("text.npz", "no file of tries"),
                           ("other.npz", "no file of tries")):
        with pytest.raises(ConfigError, match=expected):
            Tries.read(tmp_path / name)


def test_unusable_networks_are_one_line(tmp_path: Path) -> None:
    cases = {
        "missing": "cannot be read", "text": "is no usable ONNX network", "empty": "is no usable ONNX network",
        "large": f"the limit is {MAX_BYTES}", "nocard": "cannot be read", "badcard": "is no card of a scorer",
        "other": "is for patches of 16 cells", "values": "was trained on other values",
    }
    for name in ("text", "nocard", "badcard", "other", "values"):
        (tmp_path / f"{name}.onnx").write_text("no network")
    (tmp_path / "empty.onnx").touch()
    (tmp_path / "large.onnx").write_bytes(bytes(MAX_BYTES + 1))
    for name in ("missing", "text", "empty", "large"):
        card(tmp_path / f"{name}.onnx")
    card(tmp_path / "other.onnx", patch={"size": 16, "step": STEP})
    card(tmp_path / "values.onnx", numbers=["a", "c"])
    (tmp_path / "badcard.json").write_text("{}")
    for name, expected in cases.items():
        with pytest.raises(ConfigError, match=expected) as raised:
            Network.load(tmp_path / f"{name}.onnx", ["a", "b"])
        assert "\n" not in str(raised.value)
