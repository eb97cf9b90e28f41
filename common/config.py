"""Configuration: a cell file names a robot, a world, a pipeline and its services; every value has a unit and bounds.

`load_cell` resolves the names, applies `--set PATH=VALUE` overrides and checks all of it. A service declares a
`Config` (a `Parameters`); its fields are either parameters, set under `services.<name>` of the cell, or sections of
the cell, which are recognised by their type and filled in. Only what a service declares reaches it: `World` (where
things really lie) is declared by the simulated hardware alone, everything else takes `Surroundings`.
"""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from common.errors import ConfigError, UnknownName

Number = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
Coordinate = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Rgb = tuple[
    Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=1)]
]


class Section(BaseModel):
    """A part of the cell that several services may need."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Parameters(BaseModel):
    """Base of the `Config` of a service, and of the `Options` of a planner or hardware backend."""

    model_config = ConfigDict(extra="forbid", frozen=True)


# --- robot ------------------------------------------------------------------------------------------------------


class ParallelLinkage(Section):
    """Fingers on parallelograms, so that their pads stay parallel; the driven joint is an angle, 0 when open.

    At an angle a the pads are 2 * length * (sin(open_angle - a) - sin(open_angle - closed)) apart [m].
    """

    length: Length = Field(description="of the four bars [m]")
    open_angle: float = Field(ge=-1.6, le=1.6, description="of the bars from the tool axis when open, outwards [rad]")
    closed: float = Field(gt=0, le=3.2, description="driven joint when the pads meet [rad]")


class GripperConfig(Section):
    """A parallel gripper: `width` is the distance between the inner faces of the fingers [m].

    The first of the joints is driven. Without a linkage it slides by half the width.
    """

    group: str = Field("gripper", description="name of the fingers as a group")
    joints: list[str] = Field(min_length=1, description="finger joints, the driven one first")
    mimic: list[Number] = Field([], description="each joint per driven joint; all 1 when empty")
    linkage: ParallelLinkage | None = Field(None, description="how the driven joint opens them; else each slides")
    links: list[str] = Field(description="links that may touch what is grasped")
    max_width: Length = Field(0.08, description="fully open [m]")
    speed: Length = Field(0.2, description="closing speed of the width [m/s]")
    acceleration: Length = Field(2.0, description="of the width [m/s^2]")
    jerk: float = Field(50.0, gt=0, le=1e4, description="of the width [m/s^3]")
    max_effort: float = Field(70.0, gt=0, le=1e4, description="grip force [N]")
    controller: str = Field("gripper_controller", description="name of its controller, the source of its state")
    named_widths: dict[str, Annotated[float, Field(ge=0, le=1)]] = Field({}, description="such as open, closed [m]")

    @model_validator(mode="after")
    def _fits(self) -> GripperConfig:
        if self.mimic and len(self.mimic) != len(self.joints):
            raise ValueError(f"gripper.mimic has {len(self.mimic)} values for {len(self.joints)} joints")
        if self.mimic and self.mimic[0] != 1:
            raise ValueError(f"gripper.mimic begins with the driven joint itself: 1, not {self.mimic[0]:g}")
        if self.linkage is not None:
            bars = self.linkage
            opens = 2 * bars.length * (math.sin(bars.open_angle) - math.sin(bars.open_angle - bars.closed))
            if not abs(opens - self.max_width) <= 1e-4:
                raise ValueError(f"gripper.linkage opens to {opens:.4f} m, but max_width is {self.max_width:g} m")
        for name, width in self.named_widths.items():
            if width > self.max_width:
                raise ValueError(f"named width {name} is {width:g} m, more than max_width {self.max_width:g} m")
        return self


class AttachmentConfig(Section):
    """Another URDF whose root is fixed to a link of the robot, such as a gripper."""

    urdf: str = Field(description="path, or package://<package>/... from an installed description package")
    parent_link: str
    position: Point = Field((0.0, 0.0, 0.0), description="of its root in parent_link [m]")
    rpy: tuple[Number, Number, Number] = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw [rad], R = Rz Ry Rx")


class TcpConfig(Section):
    """A tool centre point that the URDF does not have, fixed to one of its links."""

    link: str = Field(description="its name")
    parent: str
    position: Point = Field((0.0, 0.0, 0.0), description="in parent [m]")
    rpy: tuple[Number, Number, Number] = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw [rad], R = Rz Ry Rx")


class HardwareConfig(Section):
    """The backend that moves the joints: a module of common/hardware, or a dotted module of your own."""

    backend: str = "mock"
    options: dict[str, Any] = {}


class RobotConfig(Section):
    """A robot: its descriptions, the group that is planned for, and limits that the URDF does not give."""

    name: str
    urdf: str = Field(description="path, or package://<package>/... from an installed description package")
    srdf: str = Field("", description="as urdf; its disabled collision pairs are used")
    package_dirs: list[str] = Field([], description="where package:// is looked up, before the installed packages")
    attachments: list[AttachmentConfig] = Field([], description="descriptions that are added to the URDF")
    group: str = "arm"
    group_aliases: list[str] = []
    joints: list[str] = Field(min_length=1, description="joints of the group, in order")
    base_link: str
    base_position: Point = Field((0.0, 0.0, 0.0), description="of base_link in world [m]")
    base_rpy: tuple[Number, Number, Number] = Field(
        (0.0, 0.0, 0.0), description="of base_link in world: roll, pitch, yaw [rad], R = Rz Ry Rx"
    )
    tcp_link: str = Field("", description="link of the tool centre point; may be left out when `tcp` defines it")
    tcp: TcpConfig | None = Field(None, description="the tool centre point, when the URDF has no link for it")
    locked_joints: dict[str, Number] = Field({}, description="joints outside the group and where planning holds them")
    named_poses: dict[str, list[Number]] = Field(description="joint positions [rad]; must have home")
    velocity_limits: list[Annotated[float, Field(gt=0, le=100)]] = Field([], description="[rad/s]; else the URDF's")
    acceleration_limits: list[Annotated[float, Field(gt=0, le=1000)]] = Field(description="[rad/s^2]")
    jerk_limits: list[Annotated[float, Field(gt=0, le=1e6)]] = Field(description="[rad/s^3]")
    controller: str = Field("controller", description="name of the arm's controller, the source of its status")
    gripper: GripperConfig | None = None
    hardware: HardwareConfig = HardwareConfig()

    @model_validator(mode="before")
    @classmethod
    def _tcp_link_is_that_of_tcp(cls, values: Any) -> Any:
        tcp = values.get("tcp") if isinstance(values, dict) else None
        link = tcp.get("link") if isinstance(tcp, dict) else getattr(tcp, "link", None)
        return values | {"tcp_link": link} if link and not values.get("tcp_link") else values

    @model_validator(mode="after")
    def _lengths_fit(self) -> RobotConfig:
        if not self.tcp_link:
            raise ValueError("tcp_link must be given, or tcp")
        if self.tcp is not None and self.tcp.link != self.tcp_link:
            raise ValueError(f"tcp_link is {self.tcp_link}, but tcp defines {self.tcp.link}")
        for field in ("velocity_limits", "acceleration_limits", "jerk_limits"):
            if field == "velocity_limits" and not self.velocity_limits:
                continue
            if len(getattr(self, field)) != len(self.joints):
                raise ValueError(f"{field} has {len(getattr(self, field))} values for {len(self.joints)} joints")
        if "home" not in self.named_poses:
            raise ValueError("named_poses must have home")
        for name, positions in self.named_poses.items():
            if len(positions) != len(self.joints):
                raise ValueError(f"named pose {name} has {len(positions)} values for {len(self.joints)} joints")
        return self


# --- world ------------------------------------------------------------------------------------------------------


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
    """A pinhole camera. +Z looks forward, +X is to the right in the picture, +Y is down."""

    frame: str = "camera_optical_frame"
    width: int = Field(640, ge=16, le=4096, description="[px]")
    height: int = Field(480, ge=16, le=4096, description="[px]")
    fx: float = Field(520.0, gt=1, le=1e5, description="focal length [px]")
    fy: float = Field(520.0, gt=1, le=1e5, description="focal length [px]")
    cx: float = Field(320.0, ge=0, le=4096, description="principal point [px]")
    cy: float = Field(240.0, ge=0, le=4096, description="principal point [px]")
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
    ball_radius: float = Field(0.03, ge=0.01, le=0.035, description="[m]")
    ball_color: Rgb = (1.0, 0.15, 0.10)
    table_height: Coordinate = Field(0.0, description="z of the surface on which balls rest [m]")


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


# --- motion -----------------------------------------------------------------------------------------------------


class Motion(Section):
    """How fast the robot moves and how hard planning tries, unless a request says otherwise."""

    velocity_scaling: float = Field(0.2, gt=0, le=1, description="fraction of the joints' velocity limits")
    acceleration_scaling: float = Field(0.2, gt=0, le=1, description="fraction of the joints' acceleration limits")
    cartesian_speed_scale: float = Field(
        1.0, gt=0, le=1, description="stretch of straight-line trajectories after retiming: t/s, v*s, a*s^2"
    )
    planning_attempts: int = Field(5, ge=1, le=100, description="tries of a sampling planner, the best is kept")
    planning_time: float = Field(10.0, gt=0, le=600, description="wall time for one plan [s]")
    object_padding: float = Field(
        0.003, ge=0, le=0.05, description="perceived objects are planned around with this much more radius [m]"
    )


class Grasp(Section):
    """How an object is taken and put down, for the tool centre point with the tool pointing down."""

    approach_clearance: float = Field(0.10, ge=0.02, le=0.5, description="pre-grasp above the grasp [m]")
    grasp_clearance: float = Field(0.0, ge=-0.02, le=0.05, description="grasp above the centre of the object [m]")
    min_grasp_z: float = Field(0.012, ge=0.0, le=0.5, description="the tool centre point never goes below this [m]")
    lift_height: float = Field(0.15, ge=0.05, le=0.5, description="lift above the grasp [m]")
    drop_z: float = Field(0.25, ge=0.18, le=0.6, description="height of release above the container [m]")


class PlannerEntry(Section):
    """A planner of the pipeline: a module of common/planning/planners, or a dotted module of your own."""

    name: str
    options: dict[str, Any] = {}


class Pipeline(Section):
    """Planners in the order in which they are tried, and the checks after them."""

    planners: list[PlannerEntry] = Field(min_length=1)
    validation_step: float = Field(0.01, gt=0, le=0.2, description="largest joint step between checked states [rad]")


class Run(Section):
    """What belongs to one run."""

    cell: str
    seed: int = Field(0, ge=0, le=2**31 - 1)
    autostart: bool = True


# --- cell -------------------------------------------------------------------------------------------------------


class ServiceEntry(Section):
    """A process of the cell: its module and its parameters, which are checked by the service itself."""

    name: str
    module: str
    parameters: dict[str, Any] = {}


class Cell(Section):
    """A resolved cell: everything that its services are configured with."""

    run: Run
    robot: RobotConfig
    world: World
    motion: Motion = Motion()
    grasp: Grasp = Grasp()
    pipeline: Pipeline
    services: dict[str, ServiceEntry]
    task: str = Field(description="the service that runs the task and ends in DONE")

    @property
    def name(self) -> str:
        """The first part of every key."""
        return self.run.cell

    def section(self, kind: type[Section]) -> Section:
        """The section of that type; surroundings are cut out of the world, without what lies in it."""
        if kind is Surroundings:
            return Surroundings.model_validate({f: getattr(self.world, f) for f in Surroundings.model_fields})
        for value in (self.run, self.robot, self.world, self.motion, self.grasp, self.pipeline):
            if type(value) is kind:
                return value
        raise TypeError(f"{kind.__name__} is not a section of a cell")


C = TypeVar("C", bound=BaseModel)
P = TypeVar("P", bound=Parameters)


def config_root() -> Path:
    """The folder of the configuration: `ZENCELL_CONFIG`, or config/ beside the packages."""
    given = os.environ.get("ZENCELL_CONFIG")
    return Path(given) if given else Path(__file__).resolve().parent.parent / "config"


def names_of(kind: str) -> list[str]:
    """Names that can be given for a kind: cells, robots, worlds or pipelines."""
    return sorted(path.stem for path in (config_root() / kind).glob("*.yaml"))


def read_yaml(path: Path) -> dict[str, Any]:
    """A mapping from a YAML file.

    Raises:
        ConfigError: the file is not there, does not parse (with line and column), or holds no mapping.
    """
    try:
        loaded = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError("file", str(path), f"can not be read: {error}") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not valid YAML"
        raise ConfigError("file", str(path), f"does not parse{where}: {problem}") from None
    if not isinstance(loaded, dict):
        raise ConfigError("file", str(path), "must hold a mapping")
    return loaded


def find_file(kind: str, name: str, beside: Path | None = None) -> Path:
    """The file that a name stands for: a path (absolute, or relative to `beside`), or a name of config/<kind>.

    Raises:
        UnknownName: with the choices.
    """
    if name.endswith((".yaml", ".yml")):
        path = (beside or Path()) / Path(name).expanduser()
        if not path.is_file():
            raise ConfigError(kind.removesuffix("s"), str(path), "is not a file")
        return path
    path = config_root() / kind / f"{name}.yaml"
    if not path.is_file():
        raise UnknownName(kind.removesuffix("s"), name, names_of(kind))
    return path


def read_robot(path: Path) -> dict[str, Any]:
    """A robot file, with references to files and folders that lie beside it made absolute.

    Raises:
        ConfigError: as `read_yaml`.
    """
    return _made_absolute(read_yaml(path), path.parent)


def _made_absolute(robot: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The robot, whose descriptions and folders of descriptions are absolute where they lie in a folder."""
    attachments = robot.get("attachments")
    for part in [robot, *(attachments if isinstance(attachments, list) else [])]:
        for field in ("urdf", "srdf"):
            reference = part.get(field) if isinstance(part, dict) else None
            if isinstance(reference, str) and "://" not in reference and (folder / reference).is_file():
                part[field] = str((folder / reference).resolve())
    packages = robot.get("package_dirs")
    if isinstance(packages, list):
        robot["package_dirs"] = [
            str((folder / name).resolve()) if isinstance(name, str) and (folder / name).is_dir() else name
            for name in packages
        ]
    return robot


def parse_override(text: str) -> tuple[list[str], Any]:
    """The dotted path and the value (as YAML) of `PATH=VALUE`."""
    path, found, value = text.partition("=")
    if not found or not path.strip():
        raise ConfigError("--set", text, "must be PATH=VALUE, for example world.count=5")
    try:
        return path.strip().split("."), yaml.safe_load(value)
    except yaml.YAMLError:
        raise ConfigError(f"--set {path}", value, "is not a YAML value") from None


def _override(tree: dict[str, Any], path: Sequence[str], value: Any) -> None:
    node = tree
    for depth, part in enumerate(path[:-1]):
        child = node.setdefault(part, {})
        if child is None:
            child = node[part] = {}
        if not isinstance(child, dict):
            raise ConfigError("--set", ".".join(path), f"can not go below {'.'.join(path[: depth + 1])}, a value")
        node = child
    node[path[-1]] = value


def check(model: type[C], values: Mapping[str, Any], prefix: str = "") -> C:
    """The model made of the values.

    Raises:
        ConfigError: names the first field that does not fit, its value and what would.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise _first_error(error, model, prefix) from None


def _first_error(error: ValidationError, model: type[BaseModel], prefix: str) -> ConfigError:
    first = error.errors(include_url=False, include_context=False)[0]
    field = ".".join(part for part in [prefix, *(str(p) for p in first["loc"])] if part)
    message = first["msg"].removeprefix("Value error, ").replace("Input should be", "must be").replace("Input ", "")
    if first["type"] == "extra_forbidden":
        names = _fields_at(model, first["loc"][:-1])
        return ConfigError(field, first["input"], f"is not a parameter; choices: {', '.join(names)}")
    if first["type"] == "missing":
        return ConfigError(field, ..., "is missing")
    if first["type"] == "value_error":
        return ConfigError(field or "cell", ..., message)
    return ConfigError(field, first["input"], message)


def _fields_at(model: type[BaseModel], location: Sequence[int | str]) -> list[str]:
    """Names of the fields of the model that lies at a location within `model`."""
    current = model
    for part in location:
        annotation = current.model_fields[str(part)].annotation if str(part) in current.model_fields else None
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            break
        current = annotation
    return sorted(name for name, f in current.model_fields.items() if not _is_section(f.annotation))


def _is_section(annotation: object) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Section)


def load_cell(
    cell: str, overrides: Sequence[str] = (), *, world: str | None = None, seed: int | None = None
) -> Cell:
    """Resolve a cell by its name in config/cells or the path of a YAML file.

    Args:
        cell: a name, or a path that ends in .yaml.
        overrides: `PATH=VALUE` each, applied after all files were read.
        world: name or path of a world that replaces the cell's.
        seed: replaces the cell's seed.

    Raises:
        ConfigError, UnknownName: one line naming the field, the value and the choices.
    """
    path = find_file("cells", cell)
    tree = read_yaml(path)
    parsed = [parse_override(text) for text in overrides]
    given = {parts[0]: value for parts, value in parsed if len(parts) == 1}  # which file to read may be overridden
    given |= {"world": world} if world is not None else {}
    tree |= {part: given[part] for part in ("robot", "world", "pipeline") if part in given}
    for part in ("robot", "world", "pipeline"):
        value = tree.get(part)
        if isinstance(value, str):
            # A path in the cell is relative to it; one that a person gives, to where the person stands.
            here = part in given and Path(value).expanduser().is_file()
            read = read_robot if part == "robot" else read_yaml
            tree[part] = read(find_file(f"{part}s", value, None if here else path.parent))
        elif part == "robot" and isinstance(value, dict):
            tree[part] = _made_absolute(value, path.parent)
        elif not isinstance(value, dict):
            raise ConfigError(part, value, f"must be a name or a mapping; choices: {', '.join(names_of(part + 's'))}")
    services = tree.get("services")
    if not isinstance(services, dict):
        raise ConfigError("services", services, "must be a mapping of services in start order")
    by_name = {str(key).rpartition(".")[2]: key for key in services}  # a dotted module goes by its last part
    for parts, value in parsed:
        if parts[0] == "services" and len(parts) > 1 and parts[1] not in services:
            if parts[1] not in by_name:
                raise UnknownName("service", parts[1], by_name)
            parts[1] = by_name[parts[1]]
        if len(parts) > 1 or parts[0] not in ("robot", "world", "pipeline"):
            _override(tree, parts, value)
    run = {"cell": tree.pop("cell", path.stem), "autostart": tree.pop("autostart", True), "seed": tree.pop("seed", 0)}
    if seed is not None:
        run["seed"] = seed
    tree["run"] = run
    tree["services"] = {name: _service_entry(name, value) for name, value in services.items()}
    return check(Cell, tree)


def _service_entry(name: str, parameters: Any) -> dict[str, Any]:
    if parameters is not None and not isinstance(parameters, dict):
        raise ConfigError(f"services.{name}", parameters, "must be a mapping of parameters")
    module = name if "." in name else f"services.{name}"
    if "." not in name and importlib.util.find_spec(module) is None:
        raise UnknownName("service", name, service_names())
    return {"name": name.rpartition(".")[2], "module": module, "parameters": parameters or {}}


def service_names() -> list[str]:
    """Services that come with the project: the modules in services/."""
    folder = Path(__file__).resolve().parent.parent / "services"
    return sorted(path.stem for path in folder.glob("[a-z]*.py"))


def service_config(cell: Cell, name: str, config: type[P]) -> P:
    """The configuration of one service: its parameters from the cell, and the sections that it declares.

    Raises:
        ConfigError: names `services.<name>.<parameter>`, the value and the bounds or choices.
    """
    entry = next((entry for entry in cell.services.values() if entry.name == name), None)
    given = dict(entry.parameters) if entry else {}
    for field, info in config.model_fields.items():
        if _is_section(info.annotation):
            given[field] = cell.section(info.annotation)  # type: ignore[arg-type]
    return check(config, given, f"services.{name}")
