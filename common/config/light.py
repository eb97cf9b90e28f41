"""The light of a simulated world."""

from __future__ import annotations

from pydantic import Field

from common.config.basics import Point, Section


class Light(Section):
    """A lamp, or light that is parallel as the sun's. Brightness is what a light meter shows where it is aimed at."""

    position: Point = Field(
        (0.5, 0.4, 1.5), description="of the lamp in world [m]; parallel light comes from the direction of it"
    )
    aim: Point = Field((0.5, 0.0, 0.0), description="where it points to in world [m]")
    parallel: bool = Field(True, description="false: a lamp, whose light falls with the square of the distance")
    illuminance: float = Field(350.0, ge=0, le=100_000, description="on a surface at `aim` that faces it [lx]")
    temperature: float = Field(6500.0, ge=1700, le=25_000, description="2700 is warm, 6500 daylight, 10000 cold [K]")
    shadow: bool = Field(True, description="whether things keep it from what lies behind them")
