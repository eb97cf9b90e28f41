"""The world: what is fixed, the cameras, and where things really lie."""

from __future__ import annotations

from pydantic import Field

from common.config.basics import Coordinate, Length, Section
from common.config.light import Light
from common.config.objects import CAMERA, TCP, CameraConfig, Container, Fixture, ObjectConfig
from common.config.short_forms import KnownShort, WorldShort

__all__ = [
    "CAMERA", "TCP", "CameraConfig", "Container", "Fixture", "Light", "ObjectConfig", "Scenery", "Surroundings",
    "World",
]


class Surroundings(KnownShort):
    """What everybody in the cell knows: what is fixed, what things are put into, where the cameras are."""

    fixtures: list[Fixture] = []
    table_height: Coordinate = Field(0.0, description="z of the surface on which things lie [m]")


class Scenery(Section):
    """What simulates the world, and the light in it: for simulated hardware and simulated cameras only."""

    simulator: str = Field("kinematic", description="what moves things: a module of common/sim, or a dotted one")
    lights: dict[str, Light] = Field(
        {}, max_length=7, description="by name; none: one above the table that makes 500 lx of daylight there"
    )
    ambient: float = Field(
        150.0, ge=0, le=100_000, description="light that comes from everywhere, into shadows too [lx]"
    )


class World(Surroundings, Scenery, WorldShort):
    """The surroundings and where things really lie: for simulated hardware only."""

    min_separation: Length = Field(0.07, description="random places: least distance of centres [m]")
    container_clearance: Length = Field(0.04, description="random places: least distance from a container [m]")
