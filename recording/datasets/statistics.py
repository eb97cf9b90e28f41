"""Statistics of features as LeRobot needs them to normalize: exact, of numbers as of pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
MAX_SIDE = 300  # [px] larger images are sampled
SAMPLED_SIDE = 150  # [px] to about this side
LEVELS = 256  # of a channel

Statistics = dict[str, list[Any]]


def of_numbers(values: npt.NDArray[Any]) -> Statistics:
    """Return the statistics of values (frames,) or (frames, n) over the frames; `std` is of the population."""
    columns = np.asarray(values, np.float64).reshape(len(values), -1)
    found: Statistics = {
        "min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist(),
        "mean": columns.mean(axis=0).tolist(), "std": columns.std(axis=0).tolist(), "count": [len(columns)],
    }
    return found | {name: np.quantile(columns, part, axis=0).tolist() for name, part in QUANTILES.items()}


class PixelStatistics:
    """Statistics per channel of images, of all frames; large images are sampled on a regular grid of pixels."""

    def __init__(self) -> None:
        """Start without images."""
        self.histogram: npt.NDArray[np.int64] = np.zeros((3, LEVELS), np.int64)
        self.count = 0

    def add(self, pixels: npt.NDArray[np.uint8]) -> None:
        """Count an RGB image (height, width, 3)."""
        longest = max(pixels.shape[:2])
        step = 1 if longest < MAX_SIDE else longest // SAMPLED_SIDE
        sampled = pixels[::step, ::step].reshape(-1, 3)
        for channel in range(3):
            self.histogram[channel] += np.bincount(sampled[:, channel], minlength=LEVELS)
        self.count += 1

    def merge(self, other: PixelStatistics) -> None:
        """Count the images of another object."""
        self.histogram += other.histogram
        self.count += other.count

    def statistics(self) -> Statistics:
        """Return the statistics in the range 0 to 1, each but the count as (3, 1, 1)."""
        levels = np.arange(LEVELS) / (LEVELS - 1)
        below = np.cumsum(self.histogram, axis=1)
        total = below[:, -1:]
        mean = (self.histogram * levels).sum(axis=1) / total[:, 0]
        variance = (self.histogram * (levels - mean[:, None]) ** 2).sum(axis=1) / total[:, 0]
        present = self.histogram > 0
        found = {
            "min": levels[present.argmax(axis=1)], "max": levels[LEVELS - 1 - present[:, ::-1].argmax(axis=1)],
            "mean": mean, "std": np.sqrt(variance),
        }
        # The lowest level that at least this part of the pixels does not exceed.
        found |= {name: levels[(below >= np.ceil(part * total)).argmax(axis=1)] for name, part in QUANTILES.items()}
        shaped: Statistics = {name: values.reshape(3, 1, 1).tolist() for name, values in found.items()}
        return shaped | {"count": [self.count]}
