"""The card of an ONNX file: what its network sees and returns, in FILE.json next to FILE.onnx."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, JsonValue, model_validator

from applications.policy.decoding import MAX_ROWS, columns
from applications.policy.interface import Chunk, ChunkKind, Observation, Vector
from applications.policy.sources.settings import PARTS, PolicyCell, StatePart
from applications.policy.sources.state import size_of, state_vector
from common.config import Parameters
from common.config.basics import Number, check
from common.errors import ConfigError

FIELD = "source.onnx"
MAX_BYTES = 1_000_000  # of a card

Values = NDArray[np.float32]
Numbers = Annotated[list[Number], Field(max_length=10_000)]
Deviation = Annotated[list[Annotated[float, Field(gt=0, le=1e9)]], Field(max_length=10_000)]


class Card(Parameters):
    """Interface of a network for one observation: inputs and output with a first dimension of 1, float32.

    Each value is (value - mean) / std on the way in, and value * std + mean on the way out; without them as it is.
    """

    format: Literal[1] = Field(description="of the card")
    joints: list[str] = Field(min_length=1, max_length=64, description="of the arm that it was trained for, in order")
    kind: ChunkKind = Field(description="of the rows")
    rate: float = Field(gt=0, le=1000, description="of the rows [Hz]")
    rows: int = Field(ge=1, le=MAX_ROWS, description="in a chunk")
    gripper: bool = Field(description="whether the last column of the output is the width of the gripper [m]")
    state: list[StatePart] = Field([], max_length=8, description=f"parts of the input of the state, in order: {PARTS}; "
                                                                 "empty: no such input")
    images: dict[str, str] = Field({}, max_length=16, description="name of the input by name of the camera: RGB (1, 3, "
                                                                  "h, w), from 0 to 1")
    image_size: tuple[int, int] | None = Field(None, description="(width, height) of the images [px]")
    state_input: str = Field("state", description="name of the input of the state")
    output: str = Field("actions", description="name of the output (1, rows, columns)")
    state_mean: Numbers = Field([], description="of the parts of the state")
    state_std: Deviation = Field([], description="of the parts of the state")
    image_mean: Numbers = Field([], description="of the three channels")
    image_std: Deviation = Field([], description="of the three channels")
    action_mean: Numbers = Field([], description="of the columns, the gripper's included")
    action_std: Deviation = Field([], description="of the columns, the gripper's included")
    training: dict[str, JsonValue] = Field({}, description="how it was trained and what it achieved, free")

    @model_validator(mode="after")
    def _require_lengths(self) -> Card:
        lengths = {"state": size_of(self.state, len(self.joints)), "image": 3, "action": self.columns}
        for what, length in lengths.items():
            for field in (f"{what}_mean", f"{what}_std"):
                if (found := len(getattr(self, field))) not in (0, length):
                    raise ValueError(f"{field} has {found} values; it must have {length} or none")
        if self.images and (self.image_size is None or not all(1 <= side <= 4096 for side in self.image_size)):
            raise ValueError(f"image_size must be two numbers from 1 to 4096, not {self.image_size}")
        if not self.state and not self.images:
            raise ValueError("a network needs a state or images")
        return self

    @property
    def columns(self) -> int:
        """Number of columns of the output."""
        return columns(self.kind, len(self.joints)) + self.gripper

    def require(self, cell: PolicyCell, path: Path) -> None:
        """Return if the observations and the arm of a cell are what the network was trained for.

        Raises:
            ConfigError: names the first difference.
        """
        if list(cell.joints) != self.joints:
            raise ConfigError(FIELD, str(path), f"is for joints {', '.join(self.joints)}; the arm has "
                                                f"{', '.join(cell.joints)}")
        for camera in self.images:
            if camera not in cell.cameras:
                raise ConfigError(FIELD, str(path), f"needs camera {camera}; the observation has "
                                                    f"{', '.join(cell.cameras) or 'none'}")
        if self.images and cell.image_size != self.image_size:
            raise ConfigError(FIELD, str(path), f"needs images of {_size(self.image_size)}; image_size is "
                                                f"{_size(cell.image_size)}")
        if self.gripper and not cell.gripper_width:
            raise ConfigError(FIELD, str(path), "moves a gripper; the cell has none")

    def inputs(self, observation: Observation) -> dict[str, Values]:
        """Return the inputs of the network by name."""
        found = {}
        if self.state:
            state = state_vector(observation, self.state, observation.gripper)
            found[self.state_input] = _normalised(state, self.state_mean, self.state_std)[None].astype(np.float32)
        for camera, name in self.images.items():
            pixels = _normalised(observation.images[camera] / 255.0, self.image_mean, self.image_std)
            found[name] = np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], np.float32)
        return found

    def blank(self) -> dict[str, Values]:
        """Return inputs of zeros, to try a network."""
        width, height = self.image_size or (1, 1)
        images = {camera: np.zeros((height, width, 3), np.uint8) for camera in self.images}
        zeros = np.zeros(len(self.joints))
        return self.inputs(Observation(0, zeros, zeros, np.eye(4), 0.0, images))

    def chunk(self, output: NDArray[Any], stamp: int) -> Chunk:
        """Return the chunk of an output of `rows * columns` values that answers the observation of a stamp."""
        actions = output.reshape(self.rows, self.columns).astype(float)
        with np.errstate(all="ignore"):
            actions = actions * (self.action_std or 1.0) + (self.action_mean or 0.0)
        values = actions[:, :-1] if self.gripper else actions
        return Chunk(stamp, self.rate, self.kind, values, actions[:, -1] if self.gripper else None)


def _normalised(values: Vector, mean: list[float], std: list[float]) -> NDArray[np.float64]:
    return np.asarray((values - (mean or 0.0)) / (std or 1.0))


def _size(size: tuple[int, int] | None) -> str:
    return f"{size[0]} x {size[1]}" if size else "as the camera sends them"


def read_card(network: Path) -> Card:
    """Return the card of a network's file.

    Raises:
        ConfigError: it is missing, or a field of it is wrong; names it.
    """
    path = network.with_suffix(".json")
    try:
        with path.open(encoding="utf-8") as file:
            values = json.loads(file.read(MAX_BYTES))
    except OSError as error:
        raise ConfigError(FIELD, str(path), f"cannot be read: {error.strerror}; an ONNX file needs this card: "
                                            "docs/policies.md") from None
    except (ValueError, RecursionError):
        raise ConfigError(FIELD, str(path), "is no JSON of a card: docs/policies.md") from None
    if not isinstance(values, dict):
        raise ConfigError(FIELD, str(path), "is no card: it must be a mapping")
    return check(Card, values, f"{FIELD}: {path}")
