"""A resolved cell, and its sections for motion, grasping, planning and watchdogs."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from common.application import find_application
from common.arms import arm_table
from common.config.arms import require_distinct
from common.config.basics import Section, Tunable
from common.config.io import Io
from common.config.robot import RobotConfig
from common.config.world import Container, Scenery, Surroundings, World
from common.errors import UnknownName
from common.remapping import POSE_KEYS, is_cell


class Motion(Section):
    """Speed of motions and effort of planning, unless a request overrides them."""

    velocity_scaling: Tunable[float] = Field(0.2, gt=0, le=1, description="fraction of the joints' velocity limits")
    acceleration_scaling: Tunable[float] = Field(
        0.2, gt=0, le=1, description="fraction of the joints' acceleration limits"
    )
    cartesian_speed_scale: Tunable[float] = Field(
        1.0, gt=0, le=1, description="stretch of straight-line trajectories after retiming: t/s, v*s, a*s^2"
    )
    planning_attempts: Tunable[int] = Field(
        5, ge=1, le=100, description="attempts of a sampling planner; the best one is used"
    )
    planning_time: Tunable[float] = Field(10.0, gt=0, le=600, description="wall time for one plan [s]")
    object_padding: Tunable[float] = Field(
        0.003, ge=0, le=0.05, description="padding of perceived objects in planning [m]"
    )
    start_tolerance: Tunable[float] = Field(
        0.05, ge=0, le=0.5, description="a plan may start this far beyond a joint limit, and moves inwards first [rad]"
    )


class Grasp(Section):
    """How an object is picked and placed, for the tool centre point with the tool pointing down."""

    approach_clearance: float = Field(0.10, ge=0.02, le=0.5, description="pre-grasp above the grasp [m]")
    grasp_clearance: float = Field(0.0, ge=-0.02, le=0.05, description="grasp above the centre of the object [m]")
    min_grasp_z: float = Field(0.012, ge=0.0, le=0.5, description="the tool centre point never goes below this [m]")
    lift_height: float = Field(0.15, ge=0.05, le=0.5, description="lift above the grasp [m]")
    drop_z: float = Field(0.225, ge=0.05, le=0.6, description="height of release above the container [m]")

    max_tilt: float | None = Field(
        None, ge=0.0, le=1.5, description="largest tilt of the tool at a grasp [rad]; default: 0, and 0.35 for an arm "
        "of fewer than six joints, which cannot choose it")

    def tilt(self, joints: int) -> float:
        """Return the largest tilt at a grasp of an arm with this many joints [rad]."""
        return self.max_tilt if self.max_tilt is not None else 0.0 if joints >= 6 else 0.35

    def height(self, z: float) -> float:
        """Return z of the tool centre point at the grasp of an object with its centre at z [m]."""
        return max(z + self.grasp_clearance, self.min_grasp_z)


class PlannerEntry(Section):
    """A planner of the pipeline: a module of common/planning/planners, or a dotted module of a user."""

    name: str
    options: dict[str, Any] = {}


class Pipeline(Section):
    """Planners in the order of their use, and the validation of their plans."""

    planners: list[PlannerEntry] = Field(min_length=1)
    validation_step: Tunable[float] = Field(
        0.01, gt=0, le=0.2, description="largest joint step between validated states [rad]"
    )


def _cell(name: str) -> str:
    if not is_cell(name):
        raise ValueError(f"{name!r} is no name of a cell, the first part of its keys: use letters, digits, _, - and .")
    return name


class Run(Section):
    """Settings of one run."""

    cell: Annotated[str, AfterValidator(_cell)]
    seed: int = Field(0, ge=0, le=2**31 - 1)
    autostart: bool = True


class Watchdogs(Section):
    """Timeouts of processes that are alive but stuck; wall time."""

    loop: float = Field(
        5.0, ge=0, le=600, description="a service whose event loop is stuck for this long ends itself; 0: never [s]"
    )
    silence: float = Field(
        7.0, ge=0, le=600, description="a process that is silent for this long is killed and restarted; 0: never [s]"
    )
    start: float = Field(
        60.0, ge=5, le=600, description="a restarted process that is not ready after this time is killed too [s]"
    )


class ServiceEntry(Section):
    """A process of the cell: its module and its parameters, which are checked by the service itself."""

    name: str = Field(description="unique in the cell: one module may run several times")
    module: str
    arm: str = Field("", description="arm that it serves, in a cell with several robots; empty: all of them")
    topics: dict[str, str] = Field({}, description="keys of the cell by the keys in its code")
    parameters: dict[str, Any] = {}

    @property
    def kind(self) -> str:
        """Last part of its module."""
        return self.module.rpartition(".")[2]

    @property
    def name_option(self) -> list[str]:
        """Command line option with its name, if that differs from its kind."""
        return [] if self.name == self.kind else ["--name", self.name]


class Members(Section):
    """All services of the cell, for services that monitor all of it."""

    services: list[str] = Field(description="in start order")
    task: str = Field("", description="the service that runs the task; empty: the cell has none")
    application: str = Field("", description="application: a name, or a dotted module")
    keys: list[dict[str, str]] = Field([], description="remapping tables: keys of the cell by the keys in the code")


class Arms(Section):
    """The arms of a cell with several robots, for services that serve or read all of them."""

    robots: dict[str, RobotConfig] = Field({}, description="by name, in the order of the cell file; empty: one robot")
    tasks: dict[str, str] = Field({}, description="name of the service that runs the task of each arm")
    own: str = Field("", description="arm of the service; empty: it serves all of them")

    @property
    def first(self) -> str:
        """The service's own arm or the first one, which carries cameras that are not fixed; empty with one robot."""
        return self.own or next(iter(self.robots), "")

    def including(self, robot: RobotConfig) -> dict[str, RobotConfig]:
        """Return all robots by arm, beginning with that of `first`; in a cell with one robot it has an empty name."""
        return {self.first: robot} | self.robots


class Cups(Section):
    """The robots of a cell whose suction cups are driven by its I/O."""

    robots: list[RobotConfig] = []


class Reach(Section):
    """Parameters of all services: some of them define the reachable workspace."""

    parameters: dict[str, dict[str, Any]] = Field({}, description="parameters by service")
    arms: dict[str, str] = Field({}, description="arm of each service that serves one of several")

    def of(self, arm: str) -> dict[str, dict[str, Any]]:
        """Return the parameters of the services of one arm and of those that serve all, by service."""
        return {name: values for name, values in self.parameters.items() if self.arms.get(name, arm) == arm}


class Cell(Section):
    """A resolved cell: the complete configuration of its services."""

    run: Run
    robot: RobotConfig
    robots: dict[str, RobotConfig] = Field({}, description="by the name of the arm; `robot` is the first of them")
    world: World
    motion: Motion = Motion()
    grasp: Grasp = Grasp()
    io: Io = Io()
    pipeline: Pipeline
    watchdogs: Watchdogs = Watchdogs()
    services: dict[str, ServiceEntry]
    task: str = Field("", description="the service that runs the task and ends in DONE; default: no task")
    application: str = Field("", description="application: a name, or a dotted module")

    @model_validator(mode="after")
    def _distinct_arms(self) -> Cell:
        require_distinct(self.robots)
        return self

    @model_validator(mode="after")
    def _vacuum_is_digital(self) -> Cell:
        for robot in (self.robot, *self.robots.values()):
            for name, kind in robot.cup_signals.items():
                names = [each for each, signal in self.io.signals.items()
                         if signal.range is None and signal.is_output == (kind == "output")]
                if name not in names:
                    raise UnknownName(f"digital {kind} in robot.gripper.vacuum.{kind}", name, names)
        return self

    @property
    def name(self) -> str:
        """The first part of every key."""
        return self.run.cell

    @property
    def task_parameters(self) -> dict[str, Any]:
        """Parameters of the service that runs the task, as the cell file has them."""
        return self.services[self.task].parameters if self.task in self.services else {}

    def _by_distance(self, arm: str) -> dict[str, Container]:
        """Return the containers of the world, the one nearest to the base of an arm first."""
        base = self.robots[arm].base_position[:2]
        return dict(sorted(self.world.containers.items(), key=lambda item: math.dist((item[1].x, item[1].y), base)))

    def _nearest_arm(self, box: Container) -> str:
        return min(self.robots, key=lambda arm: math.dist((box.x, box.y), self.robots[arm].base_position[:2]))

    def of_arm(self, arm: str) -> Cell:
        """Return the cell as one arm has it: its robot, its services and those that serve all."""
        services = {name: entry for name, entry in self.services.items() if entry.arm in ("", arm)}
        return self.model_copy(update={"robot": self.robots[arm], "robots": {}, "services": services})

    @property
    def tables(self) -> list[dict[str, str]]:
        """Remapping tables of all arms and services: keys of the cell by the keys in the code."""
        more = find_application(self.application).arm_keys if self.robots else []
        found = [arm_table(arm, more) for arm in self.robots]
        return [*found, *(each.topics for each in self.services.values() if each.topics and each.topics not in found)]

    @property
    def arms(self) -> Arms:
        """All arms of a cell with several robots, with the services that run their tasks."""
        kind = find_application(self.application).task if self.robots else ""
        tasks = {entry.arm: entry.name for entry in self.services.values() if entry.arm and entry.kind == kind}
        return Arms(robots=self.robots, tasks=tasks)

    def section(self, kind: type[Section], camera: str | None = None, arm: str = "") -> Section:
        """Return the section of a type; surroundings are the world without its objects.

        Args:
            kind: the type.
            camera: name of the camera that becomes `camera` of the surroundings; by default the first.
            arm: whose robot and task it is, in a cell with several.

        Raises:
            UnknownName: the world has no such camera.
        """
        if kind is Surroundings:
            around = {f: getattr(self.world, f) for f in Surroundings.model_fields}
            if arm and self.world.containers:
                around["containers"] = nearest = self._by_distance(arm)
                around["container"] = next(iter(nearest.values()))
                around["filled_by_others"] = [name for name, box in nearest.items() if self._nearest_arm(box) != arm]
            return Surroundings.model_validate(around | {"camera": self.world.camera_of(camera)})
        if kind is Scenery:
            return Scenery.model_validate({f: getattr(self.world, f) for f in Scenery.model_fields})
        if kind is Members:
            names = [entry.name for entry in self.services.values()]
            task = self.arms.tasks.get(arm, self.task) if arm else self.task
            keys = [each.topics for each in self.services.values() if not each.arm and each.topics.keys() - POSE_KEYS]
            return Members(services=names, task=task, application=self.application, keys=keys if arm else self.tables)
        if kind is Cups:
            robots = self.robots.values() or (self.robot,)
            return Cups(robots=[robot for robot in robots if robot.cup_signals])
        if kind is Arms:
            return self.arms.model_copy(update={"own": arm})
        if kind is RobotConfig and arm:
            return self.robots[arm]
        if kind is Reach:
            entries = [entry for entry in self.services.values() if not arm or entry.arm in ("", arm)]
            return Reach(parameters={entry.name: entry.parameters for entry in entries},
                         arms={entry.name: entry.arm for entry in entries if entry.arm})
        for value in (self.run, self.robot, self.world, self.motion, self.grasp, self.io, self.pipeline,
                      self.watchdogs):
            if type(value) is kind:
                return value
        raise TypeError(f"{kind.__name__} is not a section of a cell")
