"""Generates the objects of a world: a heap that falls into the tray, drawn by the seed.

    generator: {module: applications.sorting.objects.heap, count: 10, kinds: test}
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import struct
import tempfile
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator

from applications.sorting.objects.kinds import (
    FRICTIONS,
    KINDS,
    MASSES,
    TEST_KINDS,
    TRAIN_KINDS,
    DrawnObject,
    draw,
)
from applications.sorting.objects.others import from_file, mesh_files
from applications.sorting.objects.stacking import GAP, silhouette, stacked
from common.cache import cache_folder
from common.config import ObjectConfig, Parameters, World
from common.errors import ConfigError
from common.robot.transforms import quaternion_to_matrix, rpy_to_matrix
from common.sim.interface import KINEMATIC

log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Mass = Annotated[float, Field(gt=0, le=20)]
Friction = Annotated[float, Field(gt=0, le=2)]

SETS = {"train": list(TRAIN_KINDS), "test": list(TEST_KINDS), "all": list(KINDS)}


class Options(Parameters):
    """Which objects, how many, and how they are placed."""

    count: int = Field(10, ge=1, le=30, description="number of objects")
    kinds: str | list[str] = Field("test", description="train, test, all, the name of a kind, or a list of names")
    meshes: str = Field("", description="folder of .obj, .stl, .ply or .urdf files, instead of kinds")
    container: str = Field("tray", description="id of the container that they fall into")
    placement: Literal["heap", "spread"] = Field("heap", description="about the middle, or all over the container")
    masses: tuple[Mass, Mass] = Field(MASSES, description="smallest and largest [kg]")
    frictions: tuple[Friction, Friction] = Field(FRICTIONS, description="smallest and largest coefficient")

    @field_validator("kinds")
    @classmethod
    def _require_known_kinds(cls, kinds: str | list[str]) -> str | list[str]:
        names = [kinds] if isinstance(kinds, str) else kinds
        choices = [*SETS, *KINDS]
        unknown = [name for name in names if name not in choices]
        if unknown or not names:
            wrong = f"{unknown[0]!r} is no kind" if unknown else "must name at least one kind"
            raise ValueError(f"{wrong}; choices: {', '.join(choices)}")
        return kinds

    @property
    def kind_names(self) -> list[str]:
        """Names of the kinds that objects are drawn from."""
        names = [self.kinds] if isinstance(self.kinds, str) else self.kinds
        return list(dict.fromkeys(kind for name in names for kind in SETS.get(name, [name])))

    @field_validator("masses", "frictions")
    @classmethod
    def _require_order(cls, values: tuple[float, float]) -> tuple[float, float]:
        if values[0] > values[1]:
            raise ValueError(f"{values[0]:g} is larger than {values[1]:g}: give the smallest first")
        return values


def generate(world: World, options: Options, seed: int) -> list[ObjectConfig]:
    """Return objects in the air above the container, which fall into it.

    The kinematic world moves nothing that is not touched: there they lie side by side, as far as there is room.

    Raises:
        ConfigError: there is no such container.
    """
    container = world.containers.get(options.container)
    if container is None:
        raise ConfigError("world.generator.container", options.container,
                          f"is no container; choices: {', '.join(world.containers)}")
    rng = np.random.default_rng(seed)
    drawn = list(islice(_drawn(options, rng), options.count))
    falls = world.simulator != KINEMATIC
    rotations = [_random_rotation(rng) if falls else _lying(each, rng) for each in drawn]
    outlines = [silhouette(each.triangles @ rotation.T) for each, rotation in zip(drawn, rotations, strict=True)]
    heap = falls and options.placement == "heap"
    positions = stacked(outlines, container, world.table_height, rng, heap=heap, gap=GAP if falls else 0.0)
    return [_config(number, each, rotation, position) for number, (each, rotation, position) in enumerate(
        zip(drawn, rotations, positions, strict=True), 1)]


def _drawn(options: Options, rng: np.random.Generator) -> Iterator[DrawnObject]:
    """Objects without end: each kind or mesh once in random order, then again.

    Raises:
        ConfigError: there are no meshes, or none can be used.
    """
    choices: list[str] | list[Path] = (
        mesh_files(Path(options.meshes).expanduser()) if options.meshes else options.kind_names)
    while True:
        unusable = 0
        for number in rng.permutation(len(choices)):
            choice = choices[number]
            if isinstance(choice, str):
                yield draw(choice, rng, options.masses, options.frictions)
                continue
            try:
                yield from_file(choice, rng, options.masses, options.frictions)
            except ConfigError as error:
                log.warning("left out: %s", error)
                unusable += 1
        if unusable == len(choices):
            raise ConfigError("world.generator.meshes", options.meshes, "has no mesh that can be used")


def _random_rotation(rng: np.random.Generator) -> Array:
    """Uniform rotation (3, 3)."""
    x, y, z, w = rng.normal(size=4)
    return quaternion_to_matrix(*(np.array([x, y, z, w]) / np.linalg.norm([x, y, z, w])))


def _lying(drawn: DrawnObject, rng: np.random.Generator) -> Array:
    """Rotation (3, 3) that turns the shortest side upright, with a random yaw."""
    axes = np.roll(np.eye(3), 2 - int(np.argmin(drawn.size)), axis=0)
    return np.asarray(rpy_to_matrix(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))) @ axes)


def _config(number: int, drawn: DrawnObject, rotation: Array, position: Array) -> ObjectConfig:
    x, y, z = position.tolist()
    roll, pitch, yaw = _rpy(rotation)
    return ObjectConfig(
        id=f"{drawn.kind}_{number}", shape="mesh", mesh=str(mesh_file(drawn.triangles)), position=(x, y, z),
        rpy=(roll, pitch, yaw), color=drawn.color, mass=drawn.mass, friction=drawn.friction)


def _rpy(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] with R = Rz Ry Rx."""
    return (math.atan2(rotation[2, 1], rotation[2, 2]), math.asin(float(np.clip(-rotation[2, 0], -1.0, 1.0))),
            math.atan2(rotation[1, 0], rotation[0, 0]))


def mesh_file(triangles: Array) -> Path:
    """Return an STL file of triangles (n, 3, 3) [m] in the cache; it is written unless it exists.

    Raises:
        ConfigError: it cannot be written.
    """
    record = np.zeros(len(triangles), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("used", "<u2")]))
    record["corners"] = triangles
    data = bytes(80) + struct.pack("<I", len(triangles)) + record.tobytes()
    path = cache_folder() / "objects" / f"{hashlib.sha256(data).hexdigest()[:32]}.stl"
    if not path.exists():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor, name = tempfile.mkstemp(dir=path.parent, suffix=".new")
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
            os.replace(name, path)
        except OSError as error:
            raise ConfigError("ZENCELL_CACHE", str(path.parent), f"cannot be written: {error.strerror}") from None
    return path
