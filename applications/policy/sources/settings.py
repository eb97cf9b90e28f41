"""Parameters of the source of a policy, and what a source has to know about its cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import Field, model_validator

from applications.policy.interface import ChunkKind
from common.config import Parameters
from common.config.basics import Number

StatePart = Literal["positions", "velocities", "gripper", "tcp", "tcp_vector"]
PARTS = ("positions and velocities (dof,), gripper (1,), tcp (7,) x, y, z and quaternion x, y, z, w in world, "
         "tcp_vector (6,) x, y, z and rotation vector in world")
SOURCES = ("callable", "onnx", "openpi")


@dataclass(frozen=True)
class PolicyCell:
    """What the observations of a cell contain and what its arm is.

    Attributes:
        joints: names of the arm's joints, in the order of every (dof,) array.
        cameras: names of the cameras of an observation.
        image_size: (width, height) [px] of its images; None: as the cameras send them.
        gripper_width: of the open gripper [m]; 0 without a gripper.
    """

    joints: Sequence[str]
    cameras: Sequence[str] = ()
    image_size: tuple[int, int] | None = None
    gripper_width: float = 0.0


class ActionFormat(Parameters):
    """Meaning of an array of actions (n, columns). One more column than `kind` needs is the gripper."""

    kind: ChunkKind = Field(
        "joints", description="joints: positions [rad]; joint_steps: added to the observed positions [rad]; tcp: x, y, "
                              "z [m] and quaternion x, y, z, w in world; tcp_steps: translation [m] and rotation "
                              "vector [rad] along the axes of world, from the observed pose")
    rate: float = Field(20.0, gt=0, le=1000, description="of the rows [Hz, cell time]")
    cumulative: bool = Field(False, description="steps are from row to row instead of from the observation")
    scale: list[Number] = Field([], max_length=64, description="factors of the columns without the gripper, or one for "
                                                               "all; velocities become steps with 1 / rate and "
                                                               "cumulative")
    gripper_closed: Number = Field(0.0, description="value of the gripper's column when closed; with gripper_open")
    gripper_open: Number | None = Field(None, description="value of the gripper's column when open; without it the "
                                                          "column is the width [m]")

    @model_validator(mode="after")
    def _require_meaning(self) -> ActionFormat:
        if self.cumulative and self.kind not in ("joint_steps", "tcp_steps"):
            raise ValueError(f"cumulative has no meaning for kind {self.kind}; choices: joint_steps, tcp_steps")
        if self.kind == "tcp" and self.scale:
            raise ValueError("scale has no meaning for kind tcp; choices: joints, joint_steps, tcp_steps")
        if self.gripper_open is not None and self.gripper_open == self.gripper_closed:
            raise ValueError(f"gripper_open and gripper_closed must differ; both are {self.gripper_open:g}")
        return self


class OpenpiKeys(Parameters):
    """Keys of an observation for a server of openpi; an empty key leaves the field out."""

    images: dict[str, str] = Field(
        {}, max_length=16, description="key by the name of the camera; by default one camera is observation/image, of "
                                       "several each is observation/NAME")
    state: str = Field("observation/state", max_length=200, description="vector of state_parts")
    state_parts: list[StatePart] = Field(["positions", "gripper"], min_length=1, max_length=8, description=PARTS)
    joints: str = Field("", max_length=200, description="joint positions [rad]")
    gripper: str = Field("", max_length=200, description="(1,) gripper, as in the column of the actions")
    prompt: str = Field("prompt", max_length=200, description="instruction")
    api_key: str = Field("", max_length=1000, repr=False, description="that the server requires")


class SourceConfig(Parameters):
    """Where the actions of a policy come from: exactly one of callable, onnx and openpi."""

    callable: str = Field("", max_length=1000, description="function of yours, dotted.module:name")
    onnx: str = Field("", max_length=1000, description="file of a network, with its card FILE.json next to it")
    openpi: str = Field("", max_length=1000, description="server of openpi, ws://host:port")
    timeout: float = Field(2.0, gt=0, le=600, description="longest wait for actions [s, wall time]")
    runtime: Literal["auto", "opencv", "onnxruntime"] = Field(
        "auto", description="of an ONNX file; auto: onnxruntime if it is installed, else OpenCV")
    actions: ActionFormat = Field(ActionFormat(), description="of callable and openpi; an ONNX file has it in its card")
    keys: OpenpiKeys = Field(OpenpiKeys(), description="of openpi")

    @model_validator(mode="after")
    def _require_one(self) -> SourceConfig:
        if len(self.named) != 1:
            found = " and ".join(self.named) or "none"
            raise ValueError(f"exactly one of {', '.join(SOURCES)} is required, not {found}")
        return self

    @property
    def named(self) -> list[str]:
        """The words that are set."""
        return [word for word in SOURCES if getattr(self, word)]
