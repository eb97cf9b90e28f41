"""The world: fixtures, containers, cameras, light, and objects with their poses; and its short forms.

A world may have one camera, one container and red balls in a few fields of their own. These become `cameras`,
`containers` and `objects`, which all other code uses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from common.config.basics import Coordinate, Length, Number, Point, Rgb, Section
from common.config.conveyors import Conveyor
from common.errors import UnknownName

CAMERA = "camera"  # name of a single camera
TCP = "tcp"  # as a mount: the link of the tool centre point, whatever its name

Shape = Literal["sphere", "box", "cylinder", "prism", "ring", "mesh"]
NEEDS = {"sphere": ["radius"], "box": ["size", "height"], "cylinder": ["radius", "height"],
         "prism": ["polygon", "height"], "ring": ["radius", "inner_radius", "height"], "mesh": ["mesh"]}
OF_SHAPES = ("height", "size", "radius", "inner_radius", "polygon", "mesh", "scale")  # fields that not all shapes use


class Fixture(Section):
    """A solid that never moves, pose in world."""

    id: str
    shape: Literal["box", "sphere", "cylinder"] = "box"
    dimensions: list[Length] = Field(description="box x, y, z; sphere radius; cylinder radius, length [m]")
    position: Point
    rpy: tuple[Number, Number, Number] = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw [rad], R = Rz Ry Rx")
    color: Rgb = (0.5, 0.5, 0.5)
    friction: float | None = Field(
        None, gt=0, le=5, description="with physics: coefficient of sliding friction against everything; default: the "
                                      "larger one of 1 and that of the other surface"
    )

    @model_validator(mode="after")
    def _require_dimensions(self) -> Fixture:
        needed = {"box": 3, "sphere": 1, "cylinder": 2}[self.shape]
        if len(self.dimensions) != needed:
            raise ValueError(f"{self.id}: a {self.shape} has {needed} of dimensions, not {len(self.dimensions)}")
        return self


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
    source: bool = Field(False, description="objects are taken out of it: those in it do not count as put away")


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
    friction: float | None = Field(
        None, gt=0, le=5, description="with physics: coefficient of sliding friction against everything, also against "
                                      "the pads of fingers; default: of the other surface"
    )

    @model_validator(mode="after")
    def _require_fields_of_shape(self) -> ObjectConfig:
        missing = [field for field in NEEDS[self.shape] if not getattr(self, field)]
        used = [*NEEDS[self.shape], *(["scale"] if self.shape == "mesh" else [])]
        if ignored := [field for field in OF_SHAPES if field not in used and self._differs(field)]:
            raise ValueError(f"{self.id}: {ignored[0]} has no effect on a {self.shape}; choices: {', '.join(used)}")
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
        ignored = ("z", "yaw") if self.position is not None else ("rpy",) if self.x is not None else ()
        for field in ignored:
            if self._differs(field):
                of = "position, only rpy has" if self.position is not None else "x and y, only z and yaw have"
                raise ValueError(f"{self.id}: {field} has no effect on {of}")
        return self

    def _differs(self, field: str) -> bool:
        return bool(getattr(self, field) != type(self).model_fields[field].default)

    @property
    def placed(self) -> bool:
        """Whether it has a pose; else its position is random."""
        return self.position is not None or self.x is not None


class Generator(Section):
    """A module that adds objects to the world; its options are the other fields here."""

    model_config = ConfigDict(extra="allow")

    module: str = Field(min_length=1, max_length=200, description="dotted, or an entry point zencell.generators")


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


__all__ = [
    "CAMERA", "TCP", "CameraConfig", "Container", "Fixture", "Generator", "Light", "ObjectConfig", "Scenery",
    "Surroundings", "World",
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
    def destinations(self) -> list[str]:
        """Ids of the containers that objects are put into."""
        return [name for name, container in self.containers.items() if not container.source]

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
    generator: Generator | None = Field(None, description="module that adds objects, drawn by the seed")

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
    conveyors: dict[str, Conveyor] = Field({}, max_length=8, description="belts by name; each is a fixture, too")
    table_height: Coordinate = Field(0.0, description="z of the surface that carries objects [m]")
    filled_by_others: list[str] = Field([], description="containers of other arms, in a cell with several robots: set "
                                                        "by the cell, each container is of the arm nearest to it")

    @model_validator(mode="after")
    def _add_conveyors_to_fixtures(self) -> Self:
        fixtures = {fixture.id: fixture for fixture in self.fixtures}
        for name, belt in self.conveyors.items():
            solid = Fixture(id=name, dimensions=[*belt.dimensions], position=belt.position, rpy=(0.0, 0.0, belt.yaw),
                            color=belt.color)
            if fixtures.setdefault(name, solid) != solid:
                raise ValueError(f"fixtures and conveyors both have {name!r}: a conveyor is a fixture, too")
        object.__setattr__(self, "fixtures", [*fixtures.values()])
        return self


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
    slip_iterations: int = Field(
        0, ge=0, le=50, description="with physics: solver iterations that keep held objects from creeping under a force"
    )
