"""Short forms of a world: one camera, one container, and red balls, in a few fields of their own.

This is where they are read: what comes out are the `cameras`, `containers` and `objects` that all else works with.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from common.config.basics import Coordinate, Rgb, Section
from common.config.objects import CAMERA, CameraConfig, Container, ObjectConfig
from common.errors import UnknownName

MOST = 8  # balls of a layout


class KnownShort(Section):
    """Short forms of what everybody in the cell knows. `camera` and `container` are the only one, or the first."""

    container: Container = Container()
    containers: dict[str, Container] = Field({}, description="by id, in the place of a single one")
    camera: CameraConfig = CameraConfig()
    cameras: dict[str, CameraConfig] = Field({}, min_length=1, description="by name, in the place of a single one")
    ball_radius: float = Field(0.03, ge=0.01, le=0.035, description="[m]")
    ball_color: Rgb = (1.0, 0.15, 0.10)
    grip_efforts: dict[str, Annotated[float, Field(gt=0, le=1e4)]] = Field(
        {}, description="by kind of object, as detectors call it: force to grip it with [N]; else the gripper's effort"
    )
    masses: dict[str, Annotated[float, Field(gt=0, le=1000)]] = Field(
        {}, description="by kind of object, as detectors call it [kg]: the arm's controller is told what it carries"
    )

    @model_validator(mode="before")
    @classmethod
    def _containers_by_id(cls, given: Any) -> Any:
        """A single container is a mapping of one; a world of balls alone has the usual one."""
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
        """A single camera is a mapping of one; one that does not say what its frame is called has it from its name."""
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
    def _several_cameras(self) -> Self:
        """The first of several is *the* camera where none is chosen; their frames tell them apart."""
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
        """A camera by its name; the first if none is given.

        Raises:
            UnknownName: there is no such camera.
        """
        if name is not None and name not in self.cameras:
            raise UnknownName("camera", name, self.cameras)
        return self.cameras[name] if name is not None else next(iter(self.cameras.values()))

    @property
    def on_hand(self) -> bool:
        """Whether a camera sits on the robot, and looks from home only."""
        return any(camera.mount for camera in self.cameras.values())

    @model_validator(mode="after")
    def _several_containers(self) -> Self:
        """The first of several is *the* container."""
        if self.containers and self.container not in self.containers.values():
            raise ValueError("container is for a world with one: this one has "
                             f"{', '.join(self.containers)} as containers.ID")
        return self


class WorldShort(KnownShort):
    """Short forms of where things really lie: balls at given or random places."""

    layout: Literal["fixed", "random"] = "fixed"
    count: int | None = Field(None, ge=0, le=MOST, description="balls in the world, when `balls` is empty")
    spots: list[tuple[Coordinate, Coordinate]] = Field([], description="the fixed layout: the first `count` are used")
    balls: list[tuple[Coordinate, Coordinate]] = Field([], description="centres [m]; replaces layout and count")
    objects: list[ObjectConfig] = Field([], description="what can be taken and moved; with the balls")

    @model_validator(mode="after")
    def _balls_are_objects(self) -> Self:
        for i, a in enumerate(self.balls):
            for j, b in enumerate(self.balls[:i]):
                if math.dist(a, b) < 2 * self.ball_radius - 1e-9:
                    raise ValueError(f"balls {j} {list(b)} and {i} {list(a)} overlap")
        if self.layout == "fixed" and not self.balls and (self.count or 0) > len(self.spots):
            raise ValueError(f"count {self.count} is more than the {len(self.spots)} spots of the fixed layout")
        places: list[tuple[float, float] | None] = [*(self.balls or self.spots[: self._number])]
        if self.layout == "random" and not self.balls:
            places = [None] * self._number
        balls = [self._ball(f"ball_{number}", place) for number, place in enumerate(places, 1)]
        names = {ball.id for ball in balls}
        others = [thing for thing in self.objects if thing.id not in names]
        if len({thing.id for thing in others}) < len(others):
            raise ValueError(f"objects: two have one id: {', '.join(sorted(thing.id for thing in others))}")
        object.__setattr__(self, "objects", [*balls, *others])
        return self

    @property
    def spare(self) -> ObjectConfig | None:
        """What is added when nobody says what: like the first object, or a ball where there may be some."""
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

    def _ball(self, name: str, place: tuple[float, float] | None) -> ObjectConfig:
        x, y = place if place is not None else (None, None)
        return ObjectConfig(id=name, shape="sphere", radius=self.ball_radius, color=self.ball_color, x=x, y=y,
                            z=getattr(self, "table_height", 0.0))


def _has_balls(given: Mapping[str, Any]) -> bool:
    return any(given.get(field) for field in ("spots", "balls", "count")) or given.get("layout") == "random"


def _named(name: str, container: Any) -> Any:
    """A container whose id is the name under which it stands."""
    if isinstance(container, Container):
        return container.model_copy(update={"id": name})
    return {**container, "id": name} if isinstance(container, Mapping) else container


def _id_of(container: Any) -> str:
    return str(container.get("id", "box") if isinstance(container, Mapping) else getattr(container, "id", "box"))
