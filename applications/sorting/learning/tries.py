"""Grasps that were tried: what was seen and whether they held, as a struct of arrays in a file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from common.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Tries:
    """Grasps that were tried, as a struct of arrays.

    Attributes:
        patches: (n, 32, 32) float16 of `patches_of`.
        numbers: (n, k) float32 in the order of `names`.
        parts: (n, p) float32 of the geometric score, in the order of `part_names`.
        score: (n,) geometric score.
        held: (n,) bool; result: (n,) its name.
        scene: (n,) number; count: (n,) of objects in the scene.
        friction: (n,) of the pads; mass: (n,) of the only object [kg], else NaN.
        names, part_names: of the columns.
    """

    patches: npt.NDArray[np.float16]
    numbers: npt.NDArray[np.float32]
    parts: npt.NDArray[np.float32]
    score: npt.NDArray[np.float32]
    held: npt.NDArray[np.bool_]
    result: npt.NDArray[np.str_]
    scene: npt.NDArray[np.int64]
    count: npt.NDArray[np.int64]
    friction: npt.NDArray[np.float32]
    mass: npt.NDArray[np.float32]
    names: npt.NDArray[np.str_]
    part_names: npt.NDArray[np.str_]

    def __len__(self) -> int:
        """Return the number of tries."""
        return len(self.held)

    def save(self, path: Path) -> None:
        """Write a file, completely or not at all."""
        part = path.with_name(path.name + ".part")
        with part.open("wb") as file:
            np.savez_compressed(file, **vars(self))
        os.replace(part, path)

    @classmethod
    def read(cls, path: Path) -> Tries:
        """Read a file.

        Raises:
            ConfigError: it is missing or no file of tries.
        """
        try:
            with np.load(path, allow_pickle=False) as stored:
                return cls(**{each.name: stored[each.name] for each in fields(cls)})
        except OSError as error:
            raise ConfigError("data", str(path), f"cannot be read: {error.strerror or 'no such format'}") from None
        except (ValueError, KeyError, EOFError):
            raise ConfigError("data", str(path), "is no file of tries: `zencell grasp data` writes one") from None

    @classmethod
    def joined(cls, several: Sequence[Tries]) -> Tries:
        """Return all of several, which have the same columns."""
        fixed = {name: getattr(several[0], name) for name in ("names", "part_names")}
        return cls(**fixed, **{each.name: np.concatenate([getattr(tries, each.name) for tries in several])
                               for each in fields(cls) if each.name not in fixed})
