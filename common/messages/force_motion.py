"""Force motions: motions of the tool that end, or yield, by the wrench at the tool."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from common.messages.basics import Vector3
from common.messages.execution import ExecuteRequest, JogFrame

UNIT = 1e-3  # tolerance of the length of a direction


class ForceMotion(ExecuteRequest):
    """Move the tool along a straight line by the wrench at it. The requester mints `id`, which moves the robot once.

    `until`: until the tool presses with `force`. `comply`: yield to the wrench for `timeout`, pressing with `force`.
    `insert`: press with `force`, search a hole on a spiral, push to `depth`.

    The trajectory is the planned straight line to `max_distance`, checked against the planning scene; the tool leaves
    it by `radius` and `angle` at most. An operator's request is repeated, unchanged or without points, at least every
    second: the arm comes to rest when it is not. A task's motion ends with its process.
    """

    kind: Literal["until", "comply", "insert"]
    direction: Vector3 = Field(Vector3(z=-1.0), description="of the motion, of length 1")
    frame: JogFrame = Field("base", description="whose axes `direction` refers to")
    speed: Annotated[float, Field(gt=0, le=0.1)] = Field(0.01, description="of the tool, at most [m/s]")
    max_distance: Annotated[float, Field(gt=0, le=0.3)] = Field(0.05, description="along the direction [m]")
    force: Annotated[float, Field(ge=0, le=500)] = Field(5.0, description="of the tool along the direction [N]")
    force_limit: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        None, description="hard limit [N]; lowers robot.force_limit, and never raises it")
    torque_limit: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        None, description="hard limit at the TCP [N m]; lowers robot.torque_limit, and never raises it")
    zero: bool = Field(
        False, description="first take the wrench at rest as zero: nothing must touch the tool")
    timeout: Annotated[float, Field(gt=0, le=600)] = Field(30.0, description="cell time, holds not counted [s]")
    radius: Annotated[float, Field(ge=0, le=0.01)] = Field(
        0.003, description="comply: largest distance from the line; insert: of the spiral [m]")
    angle: Annotated[float, Field(ge=0, le=0.2)] = Field(0.05, description="largest rotation [rad]")
    tip: Annotated[float, Field(ge=0, le=0.3)] = Field(
        0.0, description="distance of the contact point from the TCP along the direction [m]: the end of a held part")
    lever: Annotated[float, Field(gt=0.01, le=1)] = Field(
        0.1, description="length that relates rotations to translations [m]")
    mass: Annotated[float, Field(gt=0, le=100)] = Field(2.0, description="of the admittance [kg]")
    damping: Annotated[float, Field(ge=100, le=1e5)] = Field(1500.0, description="of the admittance [N s/m]")
    stiffness: Annotated[float, Field(ge=0, le=1e5)] = Field(0.0, description="comply: towards the start [N/m]")
    along: bool = Field(True, description="comply: yields along the direction")
    across: bool = Field(True, description="comply: yields across the direction")
    turn: bool = Field(False, description="comply: yields in rotation")
    depth: Annotated[float, Field(gt=0, le=0.3)] = Field(0.01, description="insert: below the first contact [m]")
    surface: Annotated[float, Field(ge=0, le=0.3)] | None = Field(
        None, description="insert: expected distance of the first contact from the start; a part that gets 2 mm "
                          "farther without contact is in the hole [m]")
    pitch: Annotated[float, Field(gt=0, le=0.005)] = Field(0.0002, description="insert: of the spiral [m]")
    search_speed: Annotated[float, Field(gt=0, le=0.05)] = Field(0.005, description="insert: on the spiral [m/s]")
    tilt: Annotated[float, Field(ge=0, le=0.2)] = Field(0.0, description="insert: of the part while it searches [rad]")

    @model_validator(mode="after")
    def _require_direction(self) -> ForceMotion:
        d = self.direction
        if not abs((length := math.hypot(d.x, d.y, d.z)) - 1.0) <= UNIT:
            raise ValueError(f"direction has length {length:g}, it must be 1")
        if self.joins:
            raise ValueError("a force motion starts from rest: leave joins empty")
        if self.kind != "comply" and self.force <= 0:
            raise ValueError(f"{self.kind} needs a force above 0")
        if self.kind == "insert" and self.depth >= self.max_distance:
            raise ValueError(f"depth {self.depth:g} must be less than max_distance {self.max_distance:g}")
        return self
