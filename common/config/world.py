"""The world: fixtures, containers, cameras, light, and objects with their poses; and its short forms.

A world may have one camera, one container and red balls in a few fields of their own. These become `cameras`,
`containers` and `objects`, which all other code uses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from common.config.basics import Coordinate, Length, Rgb, Section
from common.config.objects import CAMERA, TCP, CameraConfig, Container, Fixture, Light, ObjectConfig
from common.errors import UnknownName

__all__ = [
    "CAMERA", "TCP", "CameraConfig", "Container", "Fixture", "Light", "ObjectConfig", "Scenery", "Surroundings",
    "World",
]

MAX_BALLS = 8  # of a layout


class SurroundingsFields(Section):
    """Cameras, containers and objects classes; `camera` and `container` are the only or the first one."""

    container: Container = Container()
    containers: dict[str, Container] = Field({}, description="by id, instead of a single one")
    camera: CameraConfig = CameraConfig()
    cameras: dict[str, CameraConfig] = Field({}, min_length=1, description="by name, instead of a single one")
    ball_radius: float = Field(0.03, ge=0.01, le=0.035, description="[m]")
    ball_color: Rgb = (1.0, 0.15, 0.10)
    grip_efforts: dict[str, Annotated[float, Field(gt=0, le=1e4)]] = Field(
        {}, description="grip force by object class of the detector [N]; default: the gripper's effort"
    )
    masses: dict[str, Annotated[float, Field(gt=0, le=1000)]] = Field(
        {}, description="mass by object class of the detector [kg], for the payload of the arm's controller"
    )

    @model_validator(mode="before")
    @classmethod
    def _containers_by_id(cls, given: Any) -> Any:
        """Turn a single container into a mapping; a world of balls only has a default one."""
        if not isinstance(given, Mapping):
            return given
        containers, container = given.get("containers"), given.get("container")
        if containers is None:
            if container is None and not _has_balls(given):
                return given
            container = {} if container is None else container
            return {**given, "containers": {_id_of(container): container}}
        if not isinstance(containers, Mapping) or not containers:
            return given
        containers = {name: _named(name, value) for name, value in containers.items()}
        return {"container": next(iter(containers.values())), **given, "containers": containers}

    @model_validator(mode="before")
    @classmethod
    def _cameras_by_name(cls, given: Any) -> Any:
        """Turn a single camera into a mapping; the default frame of a camera follows from its name."""
        if not isinstance(given, Mapping):
            return given
        cameras = given.get("cameras")
        if cameras is None:
            camera = given.get("camera")
            return {**given, "cameras": {CAMERA: {} if camera is None else camera}}
        if not isinstance(cameras, Mapping):
            return given
        return {**given, "cameras": {
            name: {"frame": f"{name}_optical_frame", **camera} if isinstance(camera, Mapping) else camera
            for name, camera in cameras.items()
        }}

    @model_validator(mode="after")
    def _select_camera(self) -> Self:
        """Select the first camera by default; require different frames."""
        if "camera" not in self.model_fields_set:
            self.__dict__["camera"] = self.camera_of()
        elif self.camera not in self.cameras.values():
            raise ValueError(f"camera is for a world with one: this one has {', '.join(self.cameras)} as cameras.NAME")
        names: dict[str, str] = {}
        for name, camera in self.cameras.items():
            if camera.frame in names:
                raise ValueError(f"cameras.{name} has the frame of {names[camera.frame]}: {camera.frame}")
            names[camera.frame] = name
        return self

    def camera_of(self, name: str | None = None) -> CameraConfig:
        """Return a camera by its name, by default the first.

        Raises:
            UnknownName: the world has no such camera.
        """
        if name is not None and name not in self.cameras:
            raise UnknownName("camera", name, self.cameras)
        return self.cameras[name] if name is not None else next(iter(self.cameras.values()))

    @property
    def on_hand(self) -> bool:
        """Whether a camera is mounted on the robot, and is used at home only."""
        return any(camera.mount for camera in self.cameras.values())

    @model_validator(mode="after")
    def _require_known_container(self) -> Self:
        """Require that `container` is one of `containers`."""
        if self.containers and self.container not in self.containers.values():
            raise ValueError("container is for a world with one: this one has "
                             f"{', '.join(self.containers)} as containers.ID")
        return self


class ObjectFields(SurroundingsFields):
    """Movable objects: balls at given or random positions, and any others."""

    layout: Literal["fixed", "random"] = "fixed"
    count: int | None = Field(None, ge=0, le=MAX_BALLS, description="number of balls, if `balls` is empty")
    spots: list[tuple[Coordinate, Coordinate]] = Field([], description="of the fixed layout: uses the first `count`")
    balls: list[tuple[Coordinate, Coordinate]] = Field([], description="centres [m]; replaces layout and count")
    objects: list[ObjectConfig] = Field([], description="movable objects; the balls are added")

    @model_validator(mode="after")
    def _add_balls_to_objects(self) -> Self:
        for i, a in enumerate(self.balls):
            for j, b in enumerate(self.balls[:i]):
                if math.dist(a, b) < 2 * self.ball_radius - 1e-9:
                    raise ValueError(f"balls {j} {list(b)} and {i} {list(a)} overlap")
        if self.layout == "fixed" and not self.balls and (self.count or 0) > len(self.spots):
            raise ValueError(f"count {self.count} is more than the {len(self.spots)} spots of the fixed layout")
        positions: list[tuple[float, float] | None] = [*(self.balls or self.spots[: self._number])]
        if self.layout == "random" and not self.balls:
            positions = [None] * self._number
        balls = [self._ball(f"ball_{number}", position) for number, position in enumerate(positions, 1)]
        names = {ball.id for ball in balls}
        others = [each for each in self.objects if each.id not in names]
        if len({each.id for each in others}) < len(others):
            raise ValueError(f"objects: two have one id: {', '.join(sorted(each.id for each in others))}")
        object.__setattr__(self, "objects", [*balls, *others])
        return self

    @property
    def spare(self) -> ObjectConfig | None:
        """Default of an added object: like the first one, or a ball."""
        if self.objects:
            return self.objects[0]
        return self._ball("ball", None)

    @property
    def _number(self) -> int:
        if self.count is not None:
            return self.count
        if self.layout == "random":
            return 7 if self.spots or not self.objects else 0
        return min(7, len(self.spots))

    def _ball(self, name: str, position: tuple[float, float] | None) -> ObjectConfig:
        x, y = position if position is not None else (None, None)
        return ObjectConfig(id=name, shape="sphere", radius=self.ball_radius, color=self.ball_color, x=x, y=y,
                            z=getattr(self, "table_height", 0.0))


def _has_balls(given: Mapping[str, Any]) -> bool:
    return any(given.get(field) for field in ("spots", "balls", "count")) or given.get("layout") == "random"


def _named(name: str, container: Any) -> Any:
    """Return a container with its key as its id."""
    if isinstance(container, Container):
        return container.model_copy(update={"id": name})
    return {**container, "id": name} if isinstance(container, Mapping) else container


def _id_of(container: Any) -> str:
    return str(container.get("id", "box") if isinstance(container, Mapping) else getattr(container, "id", "box"))


class Surroundings(SurroundingsFields):
    """Known to all services: fixtures, containers and cameras."""

    fixtures: list[Fixture] = []
    table_height: Coordinate = Field(0.0, description="z of the surface that carries objects [m]")


class Scenery(Section):
    """Simulator and light: for simulated hardware and simulated cameras only."""

    simulator: str = Field("kinematic", description="a module of common/sim or drivers, or a dotted module")
    lights: dict[str, Light] = Field(
        {}, max_length=7, description="by name; empty: one above the table with 500 lx of daylight"
    )
    ambient: float = Field(
        150.0, ge=0, le=100_000, description="diffuse light, also in shadows [lx]"
    )


class World(Surroundings, Scenery, ObjectFields):
    """The surroundings and the true poses of objects: for simulated hardware only."""

    min_separation: Length = Field(0.07, description="random positions: least distance of centres [m]")
    container_clearance: Length = Field(0.04, description="random positions: least distance from a container [m]")
