"""Runs a learned scorer: a small network in a file of ONNX, by OpenCV, on one thread.

The file's card, a .json of the same name, lists the numbers that the network expects besides the patch.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.learning.patches import SIZE, STEP
from common.config.files import read_file
from common.errors import ConfigError

Array = npt.NDArray[np.float64]
Values = npt.NDArray[np.float32]

SHIPPED = Path(__file__).resolve().parent.parent / "data" / "scorer.onnx"
MAX_BYTES = 1_000_000  # of a file
FIELD = "scorer"


@dataclass(frozen=True, eq=False)
class Network:
    """A network that estimates the probability that a grasp holds.

    Attributes:
        numbers: names of the values that it expects besides the patch.
    """

    numbers: tuple[str, ...]
    _net: Any

    @classmethod
    def load(cls, path: Path = SHIPPED, expected: Sequence[str] | None = None) -> Network:
        """Read a network and its card.

        Args:
            path: of the .onnx file.
            expected: names of the values that will be passed; None accepts any.

        Raises:
            ConfigError: the file or its card is missing, too large, unreadable, or for other values.
        """
        data = read_file(path, FIELD, MAX_BYTES)
        card = _read_card(path)
        numbers = tuple(card["numbers"])
        if expected is not None and numbers != tuple(expected):
            differ = sorted(set(numbers) ^ set(expected)) or ["their order"]
            raise ConfigError(FIELD, str(path), f"was trained on other values ({', '.join(differ)}): train it again, "
                                                "or use scorer: geometric")
        try:
            net = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
            made = cls(numbers, net)
            made.logits(np.zeros((1, SIZE, SIZE), np.float32), np.zeros((1, len(numbers)), np.float32))
        except cv2.error as error:
            reason = " ".join(str(error.err or error).split())[:80]
            raise ConfigError(FIELD, str(path), f"is no usable ONNX network: {reason}") from None
        return made

    def logits(self, patches: Values, numbers: Values) -> Array:
        """Return (n,) logits of the probability that grasps hold.

        Args:
            patches: (n, SIZE, SIZE) of `patches_of`.
            numbers: (n, k) values, in the order of `numbers`.
        """
        if len(patches) == 0:
            return np.zeros(0)
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            self._net.setInput(np.ascontiguousarray(patches[:, None], np.float32), "patch")
            self._net.setInput(np.ascontiguousarray(numbers, np.float32), "numbers")
            return np.asarray(self._net.forward(), float).reshape(len(patches))
        finally:
            cv2.setNumThreads(threads)

    def score(self, patches: Values, numbers: Values) -> Array:
        """Return (n,) probabilities that grasps hold."""
        return np.asarray(1 / (1 + np.exp(-self.logits(patches, numbers))))


def _read_card(path: Path) -> dict[str, Any]:
    card = path.with_suffix(".json")
    try:
        found = json.loads(card.read_text(encoding="utf-8"))
        size, step, numbers = found["patch"]["size"], found["patch"]["step"], found["numbers"]
    except OSError as error:
        raise ConfigError(FIELD, str(card), f"cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ConfigError(FIELD, str(card), "is no card of a scorer: `zencell grasp train` writes it") from None
    if (size, step) != (SIZE, STEP) or not all(isinstance(name, str) for name in numbers):
        raise ConfigError(FIELD, str(card), f"is for patches of {size} cells of {step} m, not {SIZE} of {STEP} m")
    return dict(found)
