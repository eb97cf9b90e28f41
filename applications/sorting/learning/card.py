"""The card of a learned scorer: data, split, how well it ranks and what it does not know; as .json and .md."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from applications.sorting.learning.patches import SIZE, STEP
from applications.sorting.learning.tries import Tries

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

BINS = 5  # of the calibration, with equally many tries


@dataclass(frozen=True)
class Card:
    """What a scorer was trained on and how well it ranks grasps of scenes that it was not trained on.

    Attributes:
        numbers: names of the values that the network expects besides the patch.
        patch: size and step [m] of the patch.
        parameters: number of weights.
        tries, scenes: of each part of the split.
        held: fraction of all tries.
        auc: of the network and the geometric score on the test scenes; of all, single objects and heaps.
        calibration: rows of mean predicted probability, fraction held and number of tries of the test scenes.
        seed: of training.
        note: about the data.
    """

    numbers: list[str]
    patch: dict[str, float]
    parameters: int
    tries: dict[str, int]
    scenes: dict[str, int]
    held: float
    auc: dict[str, dict[str, float]]
    calibration: list[list[float]]
    seed: int
    note: str = ""

    @classmethod
    def of(
        cls, tries: Tries, train: Bools, check: Bools, test: Bools, logits: Array, seed: int, parameters: int,
        note: str = "",
    ) -> Card:
        """Measure logits (n,) of tries on those of a mask `test`."""
        masks = {"train": train, "check": check, "test": test}
        groups = {"all": test, "single objects": test & (tries.count == 1), "heaps": test & (tries.count > 1)}
        scores = {"network": logits, "geometric": tries.score.astype(float)}
        return cls(
            numbers=tries.names.tolist(), patch={"size": SIZE, "step": STEP}, parameters=parameters,
            tries={name: int(mask.sum()) for name, mask in masks.items()},
            scenes={name: len(np.unique(tries.scene[mask])) for name, mask in masks.items()},
            held=round(float(tries.held.mean()), 4),
            auc={name: {group: round(auc(score[mask], tries.held[mask]), 4) for group, mask in groups.items()}
                 for name, score in scores.items()},
            calibration=calibration(logits[test], tries.held[test]), seed=seed, note=note)


def auc(score: Array, held: Bools) -> float:
    """Probability that a grasp that holds has a larger score than one that does not; 0.5 without both kinds."""
    positive, negative = score[held], np.sort(score[~held])
    if not len(positive) or not len(negative):
        return 0.5
    below = np.searchsorted(negative, positive, "left") + np.searchsorted(negative, positive, "right")
    return float(below.mean() / 2 / len(negative))


def calibration(logits: Array, held: Bools) -> list[list[float]]:
    """Rows of mean predicted probability, fraction held and number, in `BINS` of rising probability."""
    probability = 1 / (1 + np.exp(-logits))
    parts = np.array_split(np.argsort(probability, kind="stable"), BINS)
    return [[round(float(probability[part].mean()), 3), round(float(held[part].mean()), 3), len(part)]
            for part in parts if len(part)]


def write_card(card: Card, out: Path) -> None:
    """Write a card next to a network, as .json and as .md."""
    values = asdict(card)
    out.with_suffix(".json").write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    out.with_suffix(".md").write_text(as_text(values), encoding="utf-8")


def as_text(card: dict[str, Any]) -> str:
    """Return the card as Markdown."""
    tries, scenes = card["tries"], card["scenes"]
    lines = [
        "# Learned scorer of grasps", "",
        f"A network of {card['parameters']} weights that estimates the probability that a grasp holds. Written by "
        "`zencell grasp train`, like its figures in the .json next to it.", "",
        "## Data", "",
        "Grasps that `zencell grasp data` tried with a floating gripper in MuJoCo, on training kinds of objects (test "
        "kinds are disjoint), single and in heaps, seen by a simulated depth camera with structured noise. Friction of "
        "the pads, mass, and the error of the tool's pose were random. Scenes are not divided between the parts:", "",
        "| part | scenes | tries |", "|---|---|---|",
        *(f"| {name} | {scenes[name]} | {tries[name]} |" for name in ("train", "check", "test")), "",
        " ".join([f"{100 * card['held']:.0f} % of all tries held.", *([card["note"]] if card["note"] else [])]), "",
        "## Ranking on the test part (area under the ROC curve)", "",
        "| score | all | single objects | heaps |", "|---|---|---|---|",
        *(f"| {name} | " + " | ".join(f"{value:.3f}" for value in groups.values()) + " |"
          for name, groups in card["auc"].items()), "",
        "## Calibration on the test part", "",
        "| predicted | held | tries |", "|---|---|---|",
        *(f"| {mean:.2f} | {held:.2f} | {count:.0f} |" for mean, held, count in card["calibration"]), "",
        "## Input", "",
        f"A patch of {card['patch']['size']} x {card['patch']['size']} heights at {1e3 * card['patch']['step']:.0f} mm "
        f"in the closing frame, and: {', '.join(card['numbers'])}.", "",
        "## What it does not know", "",
        "- friction, mass and stiffness of an object, and what the camera did not see of it: it estimates a mean over "
        "those of its data;",
        "- grippers, cameras and depths of noise other than those of its data;",
        "- candidates that the geometric filters reject: its probabilities are for those that passed them;",
        "- soft, transparent or shiny objects, and anything about real contact: all data is simulated.", "",
    ]
    return "\n".join(lines)
