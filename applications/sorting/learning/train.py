"""Trains the scorer from tries, and writes it as ONNX with its card. Needs the extra `train`; nothing else does.

The network: three convolutions on the patch, one layer on the numbers, two layers on both. The closing frame of a
gripper may be turned by 180 degrees, and either finger may be first: patches are mirrored at random. The result is
calibrated on the scenes that were not trained on (Platt scaling), half of them, and judged on the other half.
"""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from applications.sorting.learning.card import Card, auc, calibration, write_card
from applications.sorting.learning.tries import Tries
from common.errors import ConfigError

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

log = logging.getLogger(__name__)

TRAINED = 0.8  # fraction of the scenes
EPOCHS, PATIENCE = 40, 8  # at most, and without an improvement
BATCH = 128
RATE, DECAY = 1e-3, 1e-2
NOISE = 0.03  # of the patch, in its units; augments the data
LEAST = 100  # tries
OPSET = 17
THREADS = 1


@dataclass(frozen=True, eq=False)
class Split:
    """Masks (n,) of tries; scenes are not divided."""

    train: Bools
    check: Bools
    test: Bools

    @classmethod
    def of(cls, scene: npt.NDArray[np.int64], seed: int) -> Split:
        """Assign scenes at random: 80 % to training, the rest half to checking and half to testing."""
        scenes = np.random.default_rng(seed).permutation(np.unique(scene))
        first = round(TRAINED * len(scenes))
        second = first + (len(scenes) - first) // 2
        return cls(*(np.isin(scene, part) for part in np.split(scenes, [first, second])))


def train(
    data: Path, out: Path, seed: int = 0, note: str = "", progress: Callable[[str], None] = log.info
) -> Card:
    """Train on a file of tries; write the network and its card.

    Args:
        data: file of `zencell grasp data`.
        out: .onnx file; the card is written next to it as .json and .md.
        seed: of the split, the weights and the order.
        note: about the data, for the card.
        progress: called with a line now and then.

    Raises:
        ConfigError: PyTorch is missing, or the file has too few tries.
    """
    require_torch()
    tries = Tries.read(data)
    if len(tries) < LEAST or tries.held.all() or not tries.held.any():
        raise ConfigError("data", str(data), f"has {len(tries)} tries, {int(tries.held.sum())} of them held; training "
                                             f"needs {LEAST}, with both outcomes")
    split = Split.of(tries.scene, seed)
    model = _fit(tries, split, seed, progress)
    logits = _logits(model, tries)
    scale, shift = platt(logits[split.check], tries.held[split.check])
    _rescale(model, scale, shift)
    _export(model, out, tries.numbers.shape[1])
    logits = scale * logits + shift
    card = Card.of(tries, split.train, split.check, split.test, logits, seed, parameters=_size(model), note=note)
    write_card(card, out)
    return card


def require_torch() -> None:
    """Raise ConfigError when PyTorch or onnx is not installed."""
    if find_spec("torch") is None or find_spec("onnx") is None:
        raise ConfigError("grasp train", ..., "needs the extra `train`: pip install 'zencell[train]'")


def _network(columns: int) -> Any:
    from torch import nn

    def block(before: int, after: int) -> list[Any]:
        return [nn.Conv2d(before, after, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2)]

    class Network(nn.Module):  # type: ignore[misc]
        """Logit of the probability that a grasp holds."""

        def __init__(self) -> None:
            super().__init__()
            self.scaling = nn.Linear(columns, columns)  # to mean 0 and deviation 1
            self.patch = nn.Sequential(*block(1, 8), *block(8, 16), *block(16, 24), nn.Flatten(), nn.Dropout(0.3),
                                       nn.Linear(384, 32), nn.ReLU())
            self.numbers = nn.Sequential(nn.Linear(columns, 32), nn.ReLU())
            self.both = nn.Sequential(nn.Linear(64, 32), nn.ReLU(), nn.Dropout(0.2), nn.Linear(32, 1))

        def forward(self, patch: Any, numbers: Any) -> Any:
            import torch

            return self.both(torch.cat([self.patch(patch), self.numbers(self.scaling(numbers))], 1))

    return Network()


def _fit(tries: Tries, split: Split, seed: int, progress: Callable[[str], None]) -> Any:
    """Return the network of the epoch with the smallest loss on the scenes for checking."""
    import torch

    torch.manual_seed(seed)
    torch.set_num_threads(THREADS)
    torch.use_deterministic_algorithms(True)
    model = _network(tries.numbers.shape[1])
    _set_scaling(model, tries.numbers[split.train])
    learned = [value for name, value in model.named_parameters() if not name.startswith("scaling")]
    optimizer = torch.optim.AdamW(learned, lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, EPOCHS, 0.02 * RATE)
    loss_of = torch.nn.BCEWithLogitsLoss()
    patches, numbers, held = _tensors(tries)
    rows = torch.from_numpy(np.flatnonzero(split.train))
    best, least, waited = copy.deepcopy(model.state_dict()), np.inf, 0
    for epoch in range(EPOCHS):
        model.train()
        for batch in rows[torch.randperm(len(rows))].split(BATCH):
            optimizer.zero_grad()
            loss = loss_of(model(_augmented(patches[batch]), numbers[batch])[:, 0], held[batch])
            loss.backward()
            optimizer.step()
        schedule.step()
        logits = _logits(model, tries)
        value = _loss(logits[split.check], tries.held[split.check])
        progress(f"epoch {epoch + 1}: loss {value:.4f}, AUC {auc(logits[split.check], tries.held[split.check]):.3f}")
        waited += 1
        if value < least:
            best, least, waited = copy.deepcopy(model.state_dict()), value, 0
        elif waited >= PATIENCE:
            break
    model.load_state_dict(best)
    return model.eval()


def _set_scaling(model: Any, numbers: npt.NDArray[np.float32]) -> None:
    import torch

    mean, deviation = numbers.mean(axis=0), np.maximum(numbers.std(axis=0), 1e-6)
    with torch.no_grad():
        model.scaling.weight[:] = torch.from_numpy(np.diag(1 / deviation).astype(np.float32))
        model.scaling.bias[:] = torch.from_numpy((-mean / deviation).astype(np.float32))


def _tensors(tries: Tries) -> tuple[Any, Any, Any]:
    import torch

    return (torch.from_numpy(tries.patches.astype(np.float32))[:, None], torch.from_numpy(tries.numbers),
            torch.from_numpy(tries.held.astype(np.float32)))


def _augmented(patches: Any) -> Any:
    """Mirror patches (n, 1, rows, columns) at random along both axes, and add noise."""
    import torch

    for axis in (2, 3):
        mirrored = torch.rand(len(patches)) < 0.5
        patches = torch.where(mirrored[:, None, None, None], patches.flip(axis), patches)
    return patches + NOISE * torch.randn_like(patches)


def _logits(model: Any, tries: Tries) -> Array:
    import torch

    model.eval()
    patches, numbers, _ = _tensors(tries)
    with torch.no_grad():
        found = [model(patch, number) for patch, number in zip(patches.split(1000), numbers.split(1000), strict=True)]
        return np.asarray(torch.cat(found)[:, 0].double().numpy())


def _loss(logits: Array, held: Bools) -> float:
    return float(np.mean(np.logaddexp(0, logits) - held * logits))


def platt(logits: Array, held: Bools, steps: int = 50) -> tuple[float, float]:
    """Scale and shift of logits (n,) with the smallest cross entropy, by Newton's method.

    Platt, "Probabilistic outputs for support vector machines" (1999).
    """
    a = np.array([1.0, 0.0])
    X = np.column_stack([logits, np.ones(len(logits))])
    for _ in range(steps):
        p = 1 / (1 + np.exp(-X @ a))
        gradient = X.T @ (p - held) + 1e-3 * (a - [1, 0])
        hessian = (X * (p * (1 - p))[:, None]).T @ X + 1e-3 * np.eye(2)
        a = a - np.linalg.solve(hessian, gradient)
    return (float(a[0]), float(a[1])) if a[0] > 0.05 else (1.0, 0.0)


def _rescale(model: Any, scale: float, shift: float) -> None:
    import torch

    with torch.no_grad():
        model.both[-1].weight *= scale
        model.both[-1].bias.mul_(scale).add_(shift)


def _export(model: Any, out: Path, columns: int) -> None:
    import torch

    out.parent.mkdir(parents=True, exist_ok=True)
    example = torch.zeros(2, 1, 32, 32), torch.zeros(2, columns)
    axes = {name: {0: "n"} for name in ("patch", "numbers", "logit")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the newer exporter needs two more packages
        torch.onnx.export(model, example, str(out), dynamo=False, opset_version=OPSET, input_names=["patch", "numbers"],
                          output_names=["logit"], dynamic_axes=axes)


def _size(model: Any) -> int:
    return sum(value.numel() for name, value in model.named_parameters() if not name.startswith("scaling"))


__all__ = ["Split", "calibration", "platt", "require_torch", "train"]
