"""Parts of a world: fixtures, containers, cameras, objects and lights."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from common.config.basics import Coordinate, Length, Number, Point, Rgb, Section

CAMERA = "camera"  # name of a single camera
TCP = "tcp"  # as a mount: the link of the tool centre point, whatever its name

Shape = Literal["sphere", "box", "cylinder", "prism", "ring", "mesh"]
NEEDS = {"sphere": ["radius"], "box": ["size", "height"], "cylinder": ["radius", "height"],
         "prism": ["polygon", "height"], "ring": ["radius", "inner_radius", "height"], "mesh": ["mesh"]}


class Fixture(Section):
    """A solid that never moves, pose in world."""

    id: str
    shape: Literal["box", "sphere", "cylinder"] = "box"
    dimensions: list[Length] = Field(description="box x, y, z; sphere radius; cylinder radius, length [m]")
    position: Point
    rpy: tuple[Number, Number, Number] = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw [rad], R = Rz Ry Rx")
    color: Rgb = (0.5, 0.5, 0.5)


class Container(Section):
    """An open box of five panels on the table, with layers of 2 x 2 slots for equal spheres."""

    id: str = "box"
    x: Coordinate = Field(0.55, description="centre [m]")
    y: Coordinate = Field(0.25, description="centre [m]")
    half_side: Length = Field(0.08, description="outer half side [m]")
    floor_thickness: Length = Field(0.005, description="[m]")
    wall_height: Length = Field(0.10, description="from the table; higher than the centres of a second layer [m]")
    wall_thickness: Length = Field(0.008, description="[m]")
    slot_offset: Length = Field(0.033, description="slots are at plus and minus this from the centre [m]")
    layers: int = Field(2, ge=1, le=5, description="of four slots each")
    color: Rgb = (1.0, 0.6, 0.0)


class CameraConfig(Section):
    """A pinhole camera: +Z forward, +X right and +Y down in the image.

    A world may name a file of `zencell calibrate` instead. A camera with a `mount` moves with the robot: its images are
    used while the arm is at home.
    """

    frame: str = f"{CAMERA}_optical_frame"
    width: int = Field(640, ge=16, le=4096, description="[px]")
    height: int = Field(480, ge=16, le=4096, description="[px]")
    fx: float = Field(520.0, gt=1, le=1e5, description="focal length [px]")
    fy: float = Field(520.0, gt=1, le=1e5, description="focal length [px]")
    cx: float = Field(320.0, ge=0, le=4096, description="principal point [px]")
    cy: float = Field(240.0, ge=0, le=4096, description="principal point [px]")
    d: list[Number] = Field(
        [], max_length=8, description="distortion of a real lens: k1, k2, p1, p2, k3, ...; camera_opencv corrects it"
    )
    mount: str = Field("", max_length=100, description="link of the robot that carries it, or tcp; empty: fixed in "
                                                       "world")
    position: Point = Field((0.40, 0.0, 0.80), description="optical centre in world, or in its mount [m]")
    rpy: tuple[Number, Number, Number] = Field(
        (math.pi, 0.0, -math.pi / 2), description="of the optical frame in world, or in its mount [rad], R = Rz Ry Rx"
    )

    @model_validator(mode="after")
    def _require_pose_on_mount(self) -> CameraConfig:
        if self.mount and not {"position", "rpy"} <= self.model_fields_set:
            raise ValueError(f"a camera with a mount needs position and rpy in {self.mount}")
        return self


class ObjectConfig(Section):
    """A movable solid.

    Its frame is at half its height, on the axis of a sphere, cylinder or ring, at the centre of a box, at the origin of
    the polygon of a prism; that of a mesh is the file's. Its pose is either `position` and `rpy` of that frame or, for
    an upright solid, `x`, `y`, the height `z` of its base, and `yaw`. Without any of them its position is random.
    """

    id: str = Field(pattern=r"^[A-Za-z0-9_.-]{1,60}$")
    shape: Shape
    position: Point | None = Field(None, description="of its own frame [m], world")
    rpy: tuple[Number, Number, Number] = Field(
        (0.0, 0.0, 0.0), description="with position: roll, pitch, yaw [rad], R = Rz Ry Rx"
    )
    x: Coordinate | None = Field(None, description="of its own frame [m], world")
    y: Coordinate | None = Field(None, description="of its own frame [m], world")
    z: Coordinate = Field(0.0, description="of its base [m]")
    yaw: Number = Field(0.0, description="[rad]")
    height: Length | None = Field(None, description="of all but a sphere and a mesh [m]")
    size: tuple[Length, Length] | tuple[Length, Length, Length] | None = Field(
        None, description="of a box, along its x and y, and z in place of height [m]"
    )
    radius: Length | None = Field(None, description="of a sphere or cylinder, outer of a ring [m]")
    inner_radius: Length | None = Field(None, description="of a ring [m]")
    polygon: list[tuple[Coordinate, Coordinate]] = Field([], description="cross-section of a prism, anticlockwise [m]")
    mesh: str = Field("", description="file of a mesh (STL, OBJ, PLY, ...), relative to the file of the world")
    scale: Length = Field(1.0, description="of the mesh: 0.001 for a file in millimetres")
    color: Rgb = (1.0, 1.0, 0.0)
    mass: float = Field(0.1, gt=0, le=100, description="[kg]")

    @model_validator(mode="after")
    def _require_fields_of_shape(self) -> ObjectConfig:
        missing = [field for field in NEEDS[self.shape] if not getattr(self, field)]
        if self.shape == "box" and self.size is not None and len(self.size) == 3:
            if self.height is not None and self.height != self.size[2]:
                raise ValueError(f"{self.id}: height {self.height:g} is not that of size, {self.size[2]:g}")
            object.__setattr__(self, "height", self.size[2])
            missing = []
        if missing:
            raise ValueError(f"{self.id}: a {self.shape} needs {' and '.join(missing)}")
        if self.radius and self.inner_radius and self.inner_radius >= self.radius:
            raise ValueError(f"{self.id}: inner_radius {self.inner_radius:g} is not below radius {self.radius:g}")
        if self.shape == "prism" and len(self.polygon) < 3:
            raise ValueError(f"{self.id}: a polygon has at least 3 corners, not {len(self.polygon)}")
        return self

    @model_validator(mode="after")
    def _require_one_pose(self) -> ObjectConfig:
        if self.position is not None and (self.x is not None or self.y is not None):
            raise ValueError(f"{self.id}: either position, or x and y")
        if (self.x is None) != (self.y is None):
            raise ValueError(f"{self.id}: x and y go together")
        return self

    @property
    def placed(self) -> bool:
        """Whether it has a pose; else its position is random."""
        return self.position is not None or self.x is not None


class Light(Section):
    """A lamp, or parallel light like that of the sun. Its illuminance is that of a light meter at `aim`."""

    position: Point = Field(
        (0.5, 0.4, 1.5), description="of the lamp in world [m]; parallel light comes from its direction"
    )
    aim: Point = Field((0.5, 0.0, 0.0), description="point in world that it is aimed at [m]")
    parallel: bool = Field(True, description="false: a lamp, whose light decreases with the square of the distance")
    illuminance: float = Field(350.0, ge=0, le=100_000, description="on a surface at `aim` that faces it [lx]")
    temperature: float = Field(6500.0, ge=1700, le=25_000, description="2700 is warm, 6500 daylight, 10000 cold [K]")
    shadow: bool = Field(True, description="whether objects cast shadows in it")
