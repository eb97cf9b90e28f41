"""Parameters of a cell that a policy controls."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, Field, model_validator

from applications.policy.proof import OnViolation, ProofOptions
from applications.policy.sources import require_source
from applications.policy.sources.settings import PolicyCell, SourceConfig
from applications.policy.topics import Control
from common.config import Parameters, Tunable
from common.config.basics import Key, Number
from common.messages import Box, Pose, Vector3
from common.planning.camera_obstacles import PointsOptions
from common.tasks.decisions import TaskConfig

Corner = tuple[Number, Number, Number]


class Region(Parameters):
    """A box in world that the tool center point stays in."""

    lower: Corner = Field(description="least x, y, z [m]")
    upper: Corner = Field(description="greatest x, y, z [m]")

    @model_validator(mode="after")
    def _require_volume(self) -> Region:
        for axis, least, most in zip("xyz", self.lower, self.upper, strict=True):
            if most - least < 0.01:
                raise ValueError(f"upper {axis} {most:g} is not at least 0.01 m above lower {axis} {least:g}")
        return self

    @property
    def box(self) -> Box:
        """The same box by its center and size."""
        (x0, y0, z0), (x1, y1, z1) = self.lower, self.upper
        center = Vector3(x=(x0 + x1) / 2, y=(y0 + y1) / 2, z=(z0 + z1) / 2)
        return Box(pose=Pose(position=center), size=Vector3(x=x1 - x0, y=y1 - y0, z=z1 - z0))


class Until(Parameters):
    """When an episode is done: all that is set holds at the same time."""

    holding: bool = Field(True, description="the gripper holds an object")
    height: Annotated[float, Field(ge=-10, le=10)] | None = Field(
        None, description="the tool center point is at least this high in world [m]")


class Memory(BaseModel):
    """What a restarted task continues with: an operator in control, and an episode that is over, stay as they are."""

    control: Control = "policy"
    operator: str = ""
    ended: Literal["", "DONE", "ERROR"] = ""
    message: str = ""  # of the end
    seconds: int = 0  # of the episode


class Config(TaskConfig):
    """Where actions come from, what is required of them, and when an episode ends. Times are cell time unless said."""

    source: SourceConfig = SourceConfig(callable="examples.policy.scripted:policy")
    cameras: dict[Annotated[str, Field(min_length=1, max_length=100)], Key] = Field(
        {"camera": "camera/image_raw"}, max_length=8, description="key of the images by the name that the policy knows")
    image_size: tuple[Annotated[int, Field(ge=8, le=4096)], Annotated[int, Field(ge=8, le=4096)]] | None = Field(
        None, description="width and height that images are resized to [px]; by default they are not")
    image_tolerance: float = Field(0.05, gt=0, le=1, description="largest difference of stamps in an observation [s]")
    observation_age: float = Field(0.5, gt=0, le=10, description="largest age of an observation [s]")
    instruction: Tunable[str] = Field("", max_length=1000, description="what to do, for policies that read it")
    interval: Tunable[float] = Field(
        0.2, ge=0.02, le=10, description="shortest time between observations for which actions are requested [s]")
    blend: Tunable[float] = Field(
        0.15, ge=0, le=2, description="time in which a new chunk replaces the one before where both have targets [s]")
    margin: Tunable[float] = Field(
        0.04, ge=0.01, le=1, description="time between the request of a motion and its join, in addition to what was "
                                         "measured for inference and proof [s]")
    on_violation: OnViolation = Field(
        "shorten", description="what is executed of a chunk that is not proved completely. shorten: its proved part; "
                               "slow: all of it, slower, if only limits of the joints are exceeded, else as shorten; "
                               "refuse: nothing, and the operator gets control")
    region: Region | None = Field(None, description="box that the tool center point stays in; by default none")
    clearance: float = Field(0.005, ge=0, le=0.2, description="distance of the arm from everything else [m]")
    points: PointsOptions | None = Field(None, description="cameras whose points are obstacles, as of motion_planner")
    acceleration: float = Field(
        0.95, gt=0, le=0.95, description="share of the acceleration limits for following a chunk; stops may use all")
    until: Until = Field(Until(), description="when the episode is done")
    seconds: Tunable[float] = Field(60.0, gt=0, le=36_000, description="longest episode, without an operator [s]")
    most_failures: Tunable[int] = Field(
        10, ge=1, le=1000, description="requests for actions that may fail in a row before the episode ends")

    def require_usable(self) -> None:
        """Check module, file or address of the source."""
        require_source(self.source, self.cell())

    def proof_options(self) -> ProofOptions:
        """Return what is required of a motion."""
        region = None if self.region is None else self.region.box
        return ProofOptions(self.on_violation, region, self.clearance, self.acceleration)

    def cell(self) -> PolicyCell:
        """Return what a source knows of the cell."""
        gripper = self.robot.gripper
        return PolicyCell(
            self.robot.joints, list(self.cameras), self.image_size, gripper.max_width if gripper is not None else 0.0)
