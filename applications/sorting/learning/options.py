"""Options of the commands about grasps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator, Field

from common.config.basics import Section


def _number(text: object) -> object:
    """Convert a text of the command line to a number, if it is one."""
    for kind in (int, float):
        try:
            return kind(text) if isinstance(text, str) else text
        except ValueError:
            continue
    return text


Whole = Annotated[int, BeforeValidator(_number)]
Real = Annotated[float, BeforeValidator(_number)]


class Shared(Section):
    """Options of several commands."""

    seed: Whole = Field(0, ge=0, description="of all random numbers")
    processes: Whole = Field(2, ge=1, le=64, description="number of processes")


class DataOptions(Shared):
    """Options of `zencell grasp data`."""

    out: Path = Field(description="file to write")
    tries: Whole = Field(20_000, ge=1, le=10_000_000, description="number of grasps, at least")


class TrainOptions(Section):
    """Options of `zencell grasp train`."""

    file: Path = Field(description="file of tries")
    out: Path = Field(description="network to write")
    note: str = Field("", max_length=500, description="about the data")
    seed: Whole = Field(0, ge=0, description="of split, weights and order")


class EvaluateOptions(Shared):
    """Options of `zencell grasp evaluate`."""

    scenes: Whole = Field(600, ge=1, le=1_000_000, description="number of scenes")
    objects: Whole = Field(1, ge=1, le=30, description="in each scene")
    force: Real = Field(20.0, gt=0, le=1000, description="of each finger [N]")
    error: Real = Field(1.0, ge=0, le=10, description="of the pose, in multiples of the cell's")
    meshes: str | None = Field(None, description="folder of meshes")
    scorer: str | None = Field(None, description="network")
