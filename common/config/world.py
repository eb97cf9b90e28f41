"""The world: what is fixed, the camera, and where things really lie."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from common.config.basics import Coordinate, Length, Number, Point, Rgb, Section
from common.errors import UnknownName

CAMERA = "camera"  # the name of a single one


class Fixture(Section):
    """A solid that never moves, pose in world."""

    id: str
    shape: Literal["box", "sphere", "cylinder"] = "box"
    dimensions: list[Length] = Field(description="box x, y, z; sphere radius; cylinder radius, length [m]")
    position: Point
    rpy: tuple[Number, Number, Number] = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw [rad], R = Rz Ry Rx")
    color: Rgb = (0.5, 0.5, 0.5)


class Container(Section):
    """An open box of five panels in which balls lie in a 2 x 2 grid of slots, in layers."""

    id: str = "box"
    x: Coordinate = Field(0.55, description="centre [m]")
    y: Coordinate = Field(0.25, description="centre [m]")
    half_side: Length = Field(0.08, description="outer half side [m]")
    floor_thickness: Length = Field(0.005, description="[m]")
    wall_height: Length = Field(0.07, description="from the table [m]")
    wall_thickness: Length = Field(0.008, description="[m]")
    slot_offset: Length = Field(0.033, description="slots lie at plus and minus this from the centre [m]")
    layers: int = Field(2, ge=1, le=5, description="of four slots each")
    color: Rgb = (1.0, 0.6, 0.0)


class CameraConfig(Section):
    """A pinhole camera. +Z looks forward, +X is to the right in the picture, +Y is down.

    A world may name a file of `zencell calibrate` in its place.
    """

    frame: str = f"{CAMERA}_optical_frame"
    width: int = Field(640, ge=16, le=4096, description="[px]")
    height: int = Field(480, ge=16, le=4096, description="[px]")
    fx: float = Field(520.0, gt=1, le=1e5, description="focal length [px]")
    fy: float = Field(520.0, gt=1, le=1e5, description="focal length [px]")
    cx: float = Field(320.0, ge=0, le=4096, description="principal point [px]")
    cy: float = Field(240.0, ge=0, le=4096, description="principal point [px]")
    d: list[Number] = Field(
        [], max_length=8, description="distortion of a real lens: k1, k2, p1, p2, k3, ...; camera_opencv takes it out"
    )
    position: Point = Field((0.40, 0.0, 0.80), description="optical centre in world [m]")
    rpy: tuple[Number, Number, Number] = Field(
        (math.pi, 0.0, -math.pi / 2), description="of the optical frame in world [rad], R = Rz Ry Rx"
    )


class ObjectConfig(Section):
    """A solid that stands upright somewhere: its cross-section about (x, y), turned by yaw, and its height."""

    id: str
    shape: Literal["box", "cylinder", "prism", "ring"]
    x: Coordinate = Field(description="of the origin of the cross-section [m], world")
    y: Coordinate = Field(description="of the origin of the cross-section [m], world")
    z: Coordinate = Field(0.0, description="of what it stands on [m]")
    yaw: Number = Field(0.0, description="[rad]")
    height: Length = Field(description="[m]")
    size: tuple[Length, Length] | None = Field(None, description="of a box, along its x and y [m]")
    radius: Length | None = Field(None, description="of a cylinder, outer of a ring [m]")
    inner_radius: Length | None = Field(None, description="of a ring [m]")
    polygon: list[tuple[Coordinate, Coordinate]] = Field([], description="cross-section of a prism, anticlockwise [m]")
    color: Rgb = (1.0, 1.0, 0.0)

    @model_validator(mode="after")
    def _has_what_its_shape_needs(self) -> ObjectConfig:
        needs = {"box": ["size"], "cylinder": ["radius"], "ring": ["radius", "inner_radius"], "prism": ["polygon"]}
        missing = [field for field in needs[self.shape] if not getattr(self, field)]
        if missing:
            raise ValueError(f"{self.id}: a {self.shape} needs {' and '.join(missing)}")
        if self.radius and self.inner_radius and self.inner_radius >= self.radius:
            raise ValueError(f"{self.id}: inner_radius {self.inner_radius:g} is not below radius {self.radius:g}")
        if self.shape == "prism" and len(self.polygon) < 3:
            raise ValueError(f"{self.id}: a polygon has at least 3 corners, not {len(self.polygon)}")
        return self


class Surroundings(Section):
    """What everybody in the cell knows: what is fixed, where the camera is, how large the balls are."""

    fixtures: list[Fixture] = []
    container: Container = Container()
    camera: CameraConfig = CameraConfig()
    cameras: dict[str, CameraConfig] = Field({}, min_length=1, description="by name, in the place of a single one")
    ball_radius: float = Field(0.03, ge=0.01, le=0.035, description="[m]")
    ball_color: Rgb = (1.0, 0.15, 0.10)
    table_height: Coordinate = Field(0.0, description="z of the surface on which balls rest [m]")


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


class World(Surroundings):
    """The surroundings and where things really lie: for simulated hardware only."""

    layout: Literal["fixed", "random"] = "fixed"
    count: int = Field(7, ge=0, le=8, description="balls in the world, when `balls` is empty")
    spots: list[tuple[Coordinate, Coordinate]] = Field([], description="the fixed layout: the first `count` are used")
    balls: list[tuple[Coordinate, Coordinate]] = Field([], description="centres [m]; replaces layout and count")
    min_separation: Length = Field(0.07, description="random: least distance of centres [m]")
    container_clearance: Length = Field(0.04, description="random: least distance of a ball from the container [m]")
    objects: list[ObjectConfig] = Field([], description="objects other than balls")

    @model_validator(mode="after")
    def _balls_do_not_overlap(self) -> World:
        for i, a in enumerate(self.balls):
            for j, b in enumerate(self.balls[:i]):
                if math.dist(a, b) < 2 * self.ball_radius - 1e-9:
                    raise ValueError(f"balls {j} {list(b)} and {i} {list(a)} overlap")
        if self.layout == "fixed" and not self.balls and self.count > len(self.spots):
            raise ValueError(f"count {self.count} is more than the {len(self.spots)} spots of the fixed layout")
        return self
