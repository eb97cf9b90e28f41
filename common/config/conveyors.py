"""Conveyor belts of a world: where they are, how they run, and their light barriers: docs/conveyor.md."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import Field, model_validator

from common.config.basics import Coordinate, Length, Number, Point, Rgb, Section


class Conveyor(Section):
    """A belt that carries what lies on it along its own x axis. It is also a fixture with its name as id."""

    dimensions: tuple[Length, Length, Length] = Field(description="length along the motion, width, height [m]")
    position: Point = Field(description="centre of the solid in world [m]")
    yaw: Number = Field(0.0, description="direction of the motion in world, from the x axis [rad]")
    speed: float = Field(0.1, ge=-2, le=2, description="while it runs [m/s]; negative: backwards")
    max_speed: float = Field(0.5, gt=0, le=2, description="most that can be requested [m/s]")
    acceleration: float = Field(0.5, gt=0, le=20, description="when it starts, stops or changes speed [m/s^2]")
    running: bool = Field(True, description="whether it runs at the start")
    end: Literal["fall", "stop", "wrap"] = Field(
        "fall", description="what happens at its end, in simulation: objects fall off; it stops while one is at the "
                            "light barrier; they come again at the start, as on a belt that circulates")
    barrier: Coordinate | None = Field(None, description="light barrier across the belt, from its start [m]")
    on_stop: Literal["stop", "run"] = Field("stop", description="what a STOP of the robot does to it")
    color: Rgb = (0.2, 0.2, 0.22)

    @model_validator(mode="after")
    def _require_values_that_fit(self) -> Self:
        if abs(self.speed) > self.max_speed:
            raise ValueError(f"speed {self.speed:g} is more than max_speed {self.max_speed:g}")
        if self.barrier is not None and not 0 < self.barrier < self.dimensions[0]:
            raise ValueError(f"barrier {self.barrier:g} is not on the belt: between 0 and {self.dimensions[0]:g}")
        if self.end == "stop" and self.barrier is None:
            raise ValueError("end: stop needs a light barrier: barrier, in m from the start of the belt")
        return self

    @property
    def top(self) -> float:
        """Height of its surface in world [m]."""
        return self.position[2] + self.dimensions[2] / 2

    @property
    def direction(self) -> tuple[float, float]:
        """Direction of its motion (x, y) in world."""
        return math.cos(self.yaw), math.sin(self.yaw)

    def along(self, x: float, y: float) -> tuple[float, float]:
        """Return how far a position in world [m] is from the start of the belt, and to the left of its middle [m]."""
        (c, s), dx, dy = self.direction, x - self.position[0], y - self.position[1]
        return c * dx + s * dy + self.dimensions[0] / 2, c * dy - s * dx

    def carries(self, x: float, y: float, bottom: float, tolerance: float = 0.003) -> bool:
        """Return whether a body with its centre at (x, y) and this bottom height lies on the belt [m]."""
        distance, off = self.along(x, y)
        on = 0 <= distance <= self.dimensions[0] and abs(off) <= self.dimensions[1] / 2
        return on and abs(bottom - self.top) <= tolerance
