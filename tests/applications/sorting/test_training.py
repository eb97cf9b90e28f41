"""Training is repeatable, and OpenCV computes what PyTorch does. Skipped without the extra `train`."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")

import torch

from applications.sorting.learning import train
from applications.sorting.learning.network import Network
from applications.sorting.learning.patches import SIZE, STEP
from common.errors import ConfigError
from tests.applications.sorting.test_scorer_files import tries


def test_opencv_computes_what_pytorch_does(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = train._network(3).eval()
    path = tmp_path / "scorer.onnx"
    train._export(model, path, 3)
    card = {"numbers": ["a", "b", "c"], "patch": {"size": SIZE, "step": STEP}}
    path.with_suffix(".json").write_text(json.dumps(card), encoding="utf-8")
    rng = np.random.default_rng(0)
    network = Network.load(path, ["a", "b", "c"])
    for count in (1, 7, 100):
        patches, numbers = rng.normal(size=(count, SIZE, SIZE)).astype("f4"), rng.normal(size=(count, 3)).astype("f4")
        with torch.no_grad():
            expected = model(torch.from_numpy(patches)[:, None], torch.from_numpy(numbers))[:, 0].numpy()
        assert network.logits(patches, numbers) == pytest.approx(expected, abs=1e-5)


def test_training_repeats_by_its_seed_and_writes_a_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "EPOCHS", 2)
    tries(400).save(tmp_path / "tries.npz")
    cards = [train.train(tmp_path / "tries.npz", tmp_path / f"{name}.onnx", seed=3, note="Noise.") for name in "ab"]
    assert cards[0] == cards[1]
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()
    text = (tmp_path / "a.md").read_text(encoding="utf-8")
    assert "Noise." in text and f"| test | 10 | {cards[0].tries['test']} |" in text
    assert Network.load(tmp_path / "a.onnx", ["a", "b", "c"]).numbers == ("a", "b", "c")


def test_too_few_tries_are_one_line(tmp_path: Path) -> None:
    tries(40).save(tmp_path / "few.npz")
    with pytest.raises(ConfigError, match=r"has 40 tries, .* needs 100"):
        train.train(tmp_path / "few.npz", tmp_path / "a.onnx")
